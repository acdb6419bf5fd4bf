"""What the cameras of an agent saw in one frame, side by side, with what there was to see."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from flcav.geometry import Boxes, inverse
from flcav.perception.camera_view import CameraView
from flcav.report import style
from flcav.report.on_picture import boxes_on_picture, show_view
from flcav.sensors.frame import Frame, SignViews

ONE_IN, SHEET_IN = 8.0, 12.0  # width of a picture alone, and of several
TITLE_IN = 0.32
ONE_ROW = 3
KINDS: Mapping[str, tuple[str, tuple[str, ...]]] = {  # in the key -> colour, categories
    "cars and vans": (style.BLUE, ("car", "van")),
    "trucks and buses": (style.PURPLE, ("truck", "bus")),
    "two-wheelers": (style.GREEN, ("motorcycle", "bicycle")),
    "pedestrians": (style.VERMILLION, ("pedestrian",)),
}
SIGNS = ("signs and lights", style.ORANGE)


@dataclass(frozen=True)
class Shot:
    """What one camera saw."""

    name: str
    view: CameraView  # of points in the world's frame
    boxes: Boxes  # (N,) of the annotated actors that show, world frame, at the instant of the picture
    track: NDArray[np.str_]  # (N,) of each of `boxes`
    signs: SignViews | None  # None: of an infrared camera


def shot(frame: Frame, camera: str) -> Shot:
    """Return what a camera of a frame saw, calibrated as it is. A thermal image becomes grey, warm is bright."""
    picture = frame.images[camera].rgb if camera in frame.images else thermal_grey(frame.infrared[camera])
    calibration, seen = frame.calibration, frame.annotations
    late_s = calibration.offset_ms.get(camera, 0.0) / 1000  # boxes are where actors are at the LiDAR spin
    boxes = replace(seen.boxes, center=seen.boxes.center + late_s * seen.velocity)
    camera_from_world, shows = inverse(frame.world_from_sensor(camera)), seen.views[camera].pixels > 0
    return Shot(
        name=camera,
        view=CameraView(picture, camera_from_world, calibration.intrinsics[camera], calibration.distortion[camera]),
        boxes=boxes[shows],
        track=seen.track[shows],
        signs=seen.signs.get(camera),
    )


def in_rows(frame: Frame, cameras: Sequence[str]) -> list[list[str]]:
    """Return the cameras as they are looked at: those that look ahead from left to right, below them those behind.

    Up to three are in one row.
    """
    yaw = {}
    for name in cameras:
        ahead = frame.agent_from_sensor[name][:2, 2]  # of the optical axis
        yaw[name] = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
    front = sorted((name for name in cameras if abs(yaw[name]) <= 90), key=lambda name: -yaw[name])
    back = sorted((name for name in cameras if abs(yaw[name]) > 90), key=lambda name: yaw[name] % 360)
    return [[*front, *back]] if len(cameras) <= ONE_ROW else [row for row in (front, back) if row]


@style.styled
def camera_sheet(title: str, rows: Sequence[Sequence[Shot]], *, boxes: bool) -> Figure:
    """Return the pictures in rows as one figure; with `boxes`, those of the actors and the rectangles of signs."""
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
        for column, each in enumerate(row):
            axes = band.add_subplot(grid[column])
            show_view(axes, each.view)
            axes.set_title(f"{title} · {each.name}" if each is shots[0] else each.name)
            if boxes:
                _draw_truth(axes, each)
    if boxes:
        style.key(figure, _key(shots))
    return figure


def _draw_truth(axes: Axes, shot: Shot) -> None:
    for colour, categories in KINDS.values():
        boxes_on_picture(axes, shot.boxes[np.isin(shot.boxes.label, categories)], shot.view, colour, width=0.8)
    if shot.signs is not None:
        for x1, y1, x2, y2 in shot.signs.box:
            axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=SIGNS[1], linewidth=1.0))


def _key(shots: Sequence[Shot]) -> list[Patch]:
    """Return the colours, with how many there are of each: one that two cameras see counts once."""
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
    """Return a thermal image (H, W) as a grey picture (H, W, 3), warm is bright; equalised in part, as cameras do."""
    rank = np.searchsorted(np.sort(image.ravel()), image) / image.size
    low, high = np.percentile(image, (30, 99.8))
    grey = 255 * (0.45 * rank + 0.55 * np.clip((image - low) / max(high - low, 1.0), 0, 1))
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
