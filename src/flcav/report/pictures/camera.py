"""Camera pictures with projected points and boxes, and with annotated actors and signs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from flcav.geometry import Boxes, inverse
from flcav.perception.images import CameraView
from flcav.report import style
from flcav.sensors.frame import Frame, SignViews

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
TICK = 1.3  # length of the heading's tick, as a multiple of the distance from a box's centre to its front
ALONG = np.linspace(0, 1, 33)  # points of an edge: distortion bends it, and it may end behind the camera
DISTANCES_M = Normalize(0, 60, clip=True)
DISTANCE_COLOURS = ListedColormap(colormaps["turbo"](np.linspace(0.08, 0.92, 64))[::-1])
ONE_IN, SHEET_IN = 8.0, 12.0  # width of a figure of one picture, and of several
TITLE_IN = 0.32
ONE_ROW = 3  # greatest number of cameras in a single row
KINDS: Mapping[str, tuple[str, tuple[str, ...]]] = {  # name in the legend -> colour, categories
    "cars and vans": (style.BLUE, ("car", "van")),
    "trucks and buses": (style.PURPLE, ("truck", "bus")),
    "two-wheelers": (style.GREEN, ("motorcycle", "bicycle")),
    "pedestrians": (style.VERMILLION, ("pedestrian",)),
}
SIGNS = ("signs and lights", style.ORANGE)


def show_view(axes: Axes, view: CameraView) -> None:
    """Show the picture of a view; the coordinates of `axes` are pixels, with (0, 0) at the centre of the first."""
    height, width = view.picture.shape[:2]
    axes.imshow(view.picture)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    style.hide_axes(axes)


def points_on_picture(axes: Axes, points: NDArray[np.float32], view: CameraView) -> ScalarMappable:
    """Draw the points (N, >=3) [m] inside the picture, coloured by distance; return the mappable of a colour bar."""
    shown = points[view.shows(points[:, :3]), :3]
    distance = np.linalg.norm(shown, axis=1)
    order = np.argsort(-distance, kind="stable")
    scale = ScalarMappable(DISTANCES_M, DISTANCE_COLOURS)
    pixels = view.project(shown[order]).T
    axes.scatter(*pixels, s=1.6, color=scale.to_rgba(distance[order]), linewidths=0, alpha=0.8, rasterized=True)
    return scale


def boxes_on_picture(axes: Axes, boxes: Boxes, view: CameraView, colour: str, *, width: float = 1.0) -> None:
    """Draw the edges of boxes, in the frame that `view` projects from, as far as they are in front of the camera.

    A tick on the ground through the front shows the heading of a box.
    """
    corners = boxes.corners()
    foot, front = corners[:, :4].mean(axis=1), corners[:, (0, 3)].mean(axis=1)
    ticks = np.stack((foot, foot + TICK * (front - foot)), axis=1)
    ends = np.concatenate((corners[:, EDGES], ticks[:, None]), axis=1)  # (boxes, edges, 2, 3)
    along = ends[:, :, :1] + ALONG[:, None] * (ends[:, :, 1:] - ends[:, :, :1])
    lines = LineCollection(
        list(view.project(along.reshape(-1, 3)).reshape(-1, len(ALONG), 2)),
        colors=colour,
        linewidths=width,
        path_effects=[withStroke(linewidth=width + 1.0, foreground="white")],
        zorder=3,
    )
    axes.add_collection(lines, autolim=False)


@dataclass(frozen=True)
class CameraShot:
    """The picture of one camera with its visible annotations."""

    name: str
    view: CameraView  # projects points of the world frame
    boxes: Boxes  # (N,) of the visible actors, world frame, at the time of the picture
    track: NDArray[np.str_]  # (N,) tracks of `boxes`
    signs: SignViews | None  # None for an infrared camera


def make_shot(frame: Frame, camera: str) -> CameraShot:
    """Return the picture and the visible annotations of a frame's camera, by its true calibration.

    Boxes with known velocity are moved from the time of the LiDAR spin to that of the picture. A thermal image becomes
    grey, with warm pixels bright.
    """
    picture = frame.images[camera].rgb if camera in frame.images else thermal_grey(frame.infrared[camera])
    calibration, seen = frame.calibration, frame.annotations
    late_s = calibration.offset_ms.get(camera, 0.0) / 1000  # after the LiDAR spin, the time of the boxes
    boxes = replace(seen.boxes, center=seen.boxes.center + late_s * np.nan_to_num(seen.velocity))
    camera_from_world = inverse(frame.world_from_sensor(camera))
    shows = seen.views[camera].pixels != 0
    return CameraShot(
        name=camera,
        view=CameraView(picture, camera_from_world, calibration.intrinsics[camera], calibration.distortion[camera]),
        boxes=boxes[shows],
        track=seen.track[shows],
        signs=seen.signs.get(camera),
    )


def arrange_cameras(frame: Frame, cameras: Sequence[str]) -> list[list[str]]:
    """Return the cameras in rows: those that look ahead, from left to right, and below them those that look back.

    Up to `ONE_ROW` cameras form a single row.
    """
    yaw = {}
    for name in cameras:
        ahead = frame.agent_from_sensor[name][:2, 2]  # of the optical axis
        yaw[name] = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
    front = sorted((name for name in cameras if abs(yaw[name]) <= 90), key=lambda name: -yaw[name])
    back = sorted((name for name in cameras if abs(yaw[name]) > 90), key=lambda name: yaw[name] % 360)
    return [[*front, *back]] if len(cameras) <= ONE_ROW else [row for row in (front, back) if row]


@style.styled
def camera_sheet(title: str, rows: Sequence[Sequence[CameraShot]], *, boxes: bool) -> Figure:
    """Return the pictures in rows as one figure; with `boxes`, it shows boxes of actors and rectangles of signs."""
    shots = [shot for row in rows for shot in row]
    width = ONE_IN if len(shots) == 1 else SHEET_IN
    aspects = [[shot.view.picture.shape[1] / shot.view.picture.shape[0] for shot in row] for row in rows]
    widest = max(map(sum, aspects))  # all pictures are as high as those of the row that fills the width
    height = width / widest + TITLE_IN
    figure = style.canvas(width, len(rows) * height + (TITLE_IN if boxes else 0))
    bands = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for band, row, ratios in zip(bands, rows, aspects, strict=True):
        free = round(widest - sum(ratios), 6)
        grid = band.add_gridspec(1, len(row) + (free > 0), width_ratios=[*ratios, *([free] if free > 0 else [])])
        for column, shot in enumerate(row):
            axes = band.add_subplot(grid[column])
            show_view(axes, shot.view)
            axes.set_title(f"{title} · {shot.name}" if shot is shots[0] else shot.name)
            if boxes:
                _draw_truth(axes, shot)
    if boxes:
        style.key(figure, _key(shots))
    return figure


def _draw_truth(axes: Axes, shot: CameraShot) -> None:
    for colour, categories in KINDS.values():
        boxes_on_picture(axes, shot.boxes[np.isin(shot.boxes.label, categories)], shot.view, colour, width=0.8)
    if shot.signs is not None:
        for x1, y1, x2, y2 in shot.signs.box:
            axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=SIGNS[1], linewidth=1.0))


def _key(shots: Sequence[CameraShot]) -> list[Patch]:
    """Return the legend: colours with numbers of objects; an object in several pictures counts once."""
    label = np.concatenate([shot.boxes.label for shot in shots])
    track = np.concatenate([shot.track for shot in shots])
    found = [(name, colour, set(track[np.isin(label, kinds)])) for name, (colour, kinds) in KINDS.items()]
    found.append((*SIGNS, {thing for shot in shots if shot.signs is not None for thing in shot.signs.thing}))
    return [
        Patch(edgecolor=colour, facecolor="none", linewidth=1.4, label=f"{name}: {len(seen)}")
        for name, colour, seen in found
        if seen
    ]


def thermal_grey(image: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return a thermal image (H, W) as a grey picture (H, W, 3), warm pixels bright, its histogram partly equalised."""
    rank = np.searchsorted(np.sort(image.ravel()), image) / image.size
    low, high = np.percentile(image, (30, 99.8))
    grey = 255 * (0.45 * rank + 0.55 * np.clip((image - low) / max(high - low, 1.0), 0, 1))
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
