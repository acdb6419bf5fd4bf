"""A LiDAR sweep in perspective, from behind and above its vehicle: returns by height, boxes by outcome, on dark.

The picture is a pinhole projection. A point is seen at (f x / z, f y / z), with z the distance along the axis of view.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flcav.arrays import Array, Array32, Mask
from flcav.geometry import Boxes
from flcav.report import style
from flcav.report.pictures.clouds import ComparedSweep, MatchedDetections

NIGHT, TEXT = "#10151b", "#e8edf1"
HEIGHTS = LinearSegmentedColormap.from_list("heights", ["#33414d", "#4d7585", "#8fb7a8", "#f3efd2"])
TO_M = 3.5  # height above the ground of the lightest returns [m]
FOUND, MISSED, FALSE = "#4cc3ff", "#ffb020", "#ff5a3c"
EYE = (-9.0, 8.5)  # position of the camera: behind the sensor and above the ground [m]
DOWN = np.radians(17.0)  # its angle below the horizon
REACH_M, ASIDE_M, NEAR_M = 62.0, 30.0, 1.0
WINDOW = (-0.9, 0.9, -0.28, 0.30)  # shown: tangents of the angles to the right and up from the axis of view
DASHES = (0, (2.5, 1.5))  # of false boxes
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def project(points: Array | Array32, ground_m: float) -> tuple[Array, Array]:
    """Return tangents (N, 2) to the right and up of points (N, 3), x ahead and y left [m], and depths (N,) [m]."""
    ahead, left = points[:, 0] - EYE[0], points[:, 1]
    above = points[:, 2] - ground_m - EYE[1]
    depth = ahead * np.cos(DOWN) - above * np.sin(DOWN)
    up = ahead * np.sin(DOWN) + above * np.cos(DOWN)
    safe = np.maximum(depth, NEAR_M)
    return np.stack((-left / safe, up / safe), axis=1), depth


@style.styled
def before_after(sweep: ComparedSweep, width_in: float = 4.4) -> Figure:
    """Return a sweep with the detections of one network, and below it with those of another, with counts."""
    low, high = WINDOW[2:]
    figure = Figure(figsize=(width_in, 2 * width_in * (high - low) / (WINDOW[1] - WINDOW[0])), facecolor=NIGHT)
    panels = figure.subplots(2, gridspec_kw={"left": 0, "right": 1, "bottom": 0, "top": 1, "hspace": 0.02})
    for axes, detections in zip(panels, (sweep.before, sweep.after), strict=True):
        draw_sweep(axes, sweep, detections)
    style.key(panels[1], list_key(), loc="lower center", labelcolor=TEXT)
    return figure


def list_key() -> list[Line2D]:
    """Return the legend of the boxes."""
    return [
        Line2D([], [], color=FOUND, linewidth=2, label="found"),
        Line2D([], [], color=MISSED, linewidth=2, label="missed"),
        Line2D([], [], color=FALSE, linewidth=2, linestyle=DASHES, label="false"),
    ]


def draw_sweep(axes: Axes, sweep: ComparedSweep, found: MatchedDetections) -> None:
    """Draw the returns, the targets by whether they are found, the false detections, and a title with the counts."""
    axes.set(facecolor=NIGHT, xlim=WINDOW[:2], ylim=WINDOW[2:], xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    ahead, aside = sweep.points[:, 0], np.abs(sweep.points[:, 1])
    near = (ahead > EYE[0] + 2) & (ahead < REACH_M) & (aside < ASIDE_M)
    draw_returns(axes, sweep.points[near], sweep.ground_m, HEIGHTS, Normalize(0.0, TO_M))
    draw_boxes(axes, sweep.targets[~found.found], sweep.ground_m, MISSED, 1.8)
    draw_boxes(axes, found.boxes[found.hit], sweep.ground_m, FOUND, 1.5)
    draw_boxes(axes, found.boxes[~found.hit], sweep.ground_m, FALSE, 1.5, DASHES)
    text = f"{found.title}: {found.found.sum()} of {len(found.found)} found, {count_false(found.hit)} false"
    axes.text(0.015, 0.955, text, transform=axes.transAxes, color=TEXT, va="top", fontweight="bold")


def count_false(hit: Mask) -> int:
    """Return the number of detections that match no target."""
    return int((~hit).sum())


def draw_returns(
    axes: Axes, points: Array | Array32, ground_m: float, colours: Colormap, heights_m: Normalize, size: float = 26.0
) -> None:
    """Draw returns (N, 3 or more) from far to near, larger where they are near, coloured by height above the ground.

    `size` is the area of a return at a metre [pt^2].
    """
    at, depth = project(points[:, :3], ground_m)
    order = np.argsort(-depth)
    area = np.clip(size / np.maximum(depth[order], NEAR_M), 0.25, 2.5)
    colour = colours(heights_m(points[order, 2] - ground_m))
    axes.scatter(*at[order].T, s=area, c=colour, linewidths=0, rasterized=True)


def draw_boxes(axes: Axes, boxes: Boxes, ground_m: float, colour: str, width: float, dash: Any = "-") -> None:
    """Draw the edges of boxes, and their footprints filled."""
    if not len(boxes):
        return
    corners = boxes.corners()  # (N, 8, 3): the lower four, then the upper four
    at, depth = project(corners.reshape(-1, 3), ground_m)
    at, near = at.reshape(-1, 8, 2), (depth.reshape(-1, 8) > NEAR_M).all(axis=1)
    lines = [box[list(edge)] for box in at[near] for edge in EDGES]
    axes.add_collection(LineCollection(lines, colors=colour, linewidths=width, linestyles=[dash], zorder=5))
    for box in at[near]:
        axes.fill(*box[:4].T, color=colour, alpha=0.25, linewidth=0, zorder=4)
