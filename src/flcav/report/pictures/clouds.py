"""Point clouds in bird's-eye view, with boxes and matched detections; a real frame with its camera image."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from flcav.geometry import Boxes, heading_vectors, transform_points
from flcav.perception.images import CameraView
from flcav.report import style
from flcav.report.pictures.camera import boxes_on_picture, show_view
from flcav.sensors.frame import Frame
from flcav.world.map.relief import Relief

GROUND_M = 0.25  # returns below this height are drawn as ground
Extent = tuple[float, float, float]  # shown behind (negative), ahead, aside [m]
EXTENT = (0.0, 60.0, 22.0)  # of a real frame


@dataclass(frozen=True)
class MatchedDetections:
    """Detections of one network in a sweep, matched with the sweep's targets."""

    title: str
    boxes: Boxes  # (N,) without detections of neutral objects
    hit: NDArray[np.bool_]  # (N,) whether matched with a target; otherwise a false positive
    found: NDArray[np.bool_]  # (M,) whether a target was matched; otherwise missed


@dataclass(frozen=True)
class ComparedSweep:
    """A sweep with detections of two networks, all in one frame: x forward, y left, at the sensor or its vehicle."""

    points: NDArray[np.float32]  # (P, >=3) x, y, z [m]; on slopes z is the height above the ground
    ground_m: float  # z of the ground in that frame
    targets: Boxes  # (M,)
    before: MatchedDetections
    after: MatchedDetections


def read_sweep(frame: Frame, lidar: str, relief: Relief | None) -> tuple[NDArray[np.float32], float]:
    """Return the points of a vehicle's sweep and the z of the ground, for `ComparedSweep`."""
    points = frame.lidar[lidar]
    if relief is None:
        return points, -float(frame.agent_from_sensor[lidar][2, 3])
    world = transform_points(frame.world_from_sensor(lidar), points[:, :3].astype(np.float64))
    return np.column_stack((points[:, :2], relief.above(world))).astype(np.float32), 0.0


def on_page(xy: NDArray) -> NDArray:
    """Return points (..., 2), x ahead and y to the left, in page coordinates (right, up)."""
    return np.stack((-xy[..., 1], xy[..., 0]), axis=-1)


def draw_points(axes: Axes, points: NDArray[np.float32], ground_m: float, extent: Extent) -> None:
    """Draw the points (P, >=3) within `extent`, those above the ground darker, and set the limits of the axes."""
    behind, ahead, aside = extent
    shown = points[(points[:, 0] > behind) & (points[:, 0] < ahead) & (np.abs(points[:, 1]) < aside)]
    low = shown[:, 2] < ground_m + GROUND_M
    for part, colour, size in ((shown[low], style.GROUND, 0.5), (shown[~low], style.POINT, 1.0)):
        axes.scatter(*on_page(part[:, :2]).T, s=size, color=colour, linewidths=0, rasterized=True)
    axes.set(xlim=(-aside, aside), ylim=(behind, ahead), aspect="equal")


def draw_boxes(
    axes: Axes, boxes: Boxes, colour: str, *, fill: float = 0.0, width: float = 1.2, dashed: bool = False
) -> None:
    """Draw the footprints of `boxes`, filled with opacity `fill`, with ticks in the direction of their headings."""
    ahead = heading_vectors(boxes.yaw)
    tip = boxes.center[:, :2] + ahead * (boxes.size[:, :1] / 2 + 0.6)
    ticks = on_page(np.stack((boxes.center[:, :2], tip), axis=1))
    outlines = on_page(boxes.corners()[:, :4, :2])
    look = {"edgecolor": colour, "linewidth": width, "zorder": 3}
    dash = (0, (3, 2)) if dashed else "solid"
    axes.add_collection(PolyCollection(list(outlines), facecolor=(colour, fill), linestyle=[dash], **look))
    axes.add_collection(LineCollection(list(ticks), **look))


@style.styled
def real_frame(
    name: str, points: NDArray[np.float32], view: CameraView, cars: Boxes, hit: NDArray[np.bool_], found: Boxes
) -> Figure:
    """Return a real frame's point cloud from above, next to its image, with the labelled cars and the detections.

    `hit` (cars,) flags the cars that were detected at IoU 0.5.
    """
    figure = style.canvas(11.0, 4.9)
    above, ahead = figure.subplots(1, 2, width_ratios=(1, 1.55))
    draw_points(above, points, -1.7, EXTENT)
    draw_boxes(above, cars[hit], style.GREEN, fill=0.25, width=1.0)
    draw_boxes(above, cars[~hit], style.MISSED, fill=0.35, width=1.0)
    draw_boxes(above, found, style.BLUE, width=1.4)
    style.hide_axes(above)
    style.scale_bar(above, 10)
    above.set_title(f"{name}: {hit.sum()} of {len(cars)} cars found at IoU 0.5")
    show_view(ahead, view)
    for boxes, colour in ((cars[hit], style.GREEN), (cars[~hit], style.MISSED), (found, style.BLUE)):
        boxes_on_picture(ahead, boxes, view, colour, width=1.0)
    colours = {"labelled, found": style.GREEN, "labelled, missed": style.MISSED, "detection": style.BLUE}
    style.key(figure, [Line2D([], [], color=colour, label=name) for name, colour in colours.items()])
    return figure
