"""A LiDAR sweep from above, with boxes: forward is up, left is left."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.report import style

GROUND_M = 0.25  # returns less than this above the ground are drawn as ground
Extent = tuple[float, float, float]  # shown behind (negative), ahead, aside [m]


@dataclass(frozen=True)
class Detections:
    """What one network found in a sweep, matched with the sweep's targets by whoever evaluated it."""

    title: str
    boxes: Boxes  # (N,) without those of neutral objects
    hit: NDArray[np.bool_]  # (N,) matched with a target; else a false positive
    found: NDArray[np.bool_]  # (M,) targets that a detection matched; else missed


@dataclass(frozen=True)
class Sweep:
    """One sweep seen by two networks. One frame for all: x forward, y left, at the sensor or its vehicle."""

    points: NDArray[np.float32]  # (P, >=3) x, y, z [m]
    ground_m: float  # z of the ground there
    targets: Boxes  # (M,)
    before: Detections
    after: Detections


def on_page(xy: NDArray) -> NDArray:
    """Return (..., 2) x ahead, y left as picture coordinates: across, up."""
    return np.stack((-xy[..., 1], xy[..., 0]), axis=-1)


def draw_points(axes: Axes, points: NDArray[np.float32], ground_m: float, extent: Extent) -> None:
    """Draw the (P, >=3) points within `extent`, what stands on the ground darker than it, and set the axes to it."""
    behind, ahead, aside = extent
    shown = points[(points[:, 0] > behind) & (points[:, 0] < ahead) & (np.abs(points[:, 1]) < aside)]
    low = shown[:, 2] < ground_m + GROUND_M
    for part, colour, size in ((shown[low], style.GROUND, 0.5), (shown[~low], style.POINT, 1.0)):
        axes.scatter(*on_page(part[:, :2]).T, s=size, color=colour, linewidths=0, rasterized=True)
    axes.set(xlim=(-aside, aside), ylim=(behind, ahead), aspect="equal")


def draw_boxes(
    axes: Axes, boxes: Boxes, colour: str, *, fill: float = 0.0, width: float = 1.2, dashed: bool = False
) -> None:
    """Draw the ground outlines of `boxes`, filled with opacity `fill`, each with a tick through its front."""
    ahead = np.stack((np.cos(boxes.yaw), np.sin(boxes.yaw)), axis=1)
    tip = boxes.center[:, :2] + ahead * (boxes.size[:, :1] / 2 + 0.6)
    ticks = on_page(np.stack((boxes.center[:, :2], tip), axis=1))
    outlines = on_page(boxes.corners()[:, :4, :2])
    look = {"edgecolor": colour, "linewidth": width, "zorder": 3}
    dash = (0, (3, 2)) if dashed else "solid"
    axes.add_collection(PolyCollection(list(outlines), facecolor=(colour, fill), linestyle=[dash], **look))
    axes.add_collection(LineCollection(list(ticks), **look))


def draw_detections(axes: Axes, sweep: Sweep, found: Detections, extent: Extent) -> None:
    """Draw the sweep, its targets and what one network found: hits, misses and false positives told apart."""
    draw_points(axes, sweep.points, sweep.ground_m, extent)
    draw_boxes(axes, sweep.targets, style.INK)
    draw_boxes(axes, sweep.targets[~found.found], style.MISSED, fill=0.6)
    draw_boxes(axes, found.boxes[found.hit], style.HIT, fill=0.35)
    draw_boxes(axes, found.boxes[~found.hit], style.FALSE, fill=0.2, dashed=True)
    axes.plot(0, 0, "^", color=style.INK, markersize=7, clip_on=False, zorder=5)


def key(found: Detections | None = None) -> list[Patch]:
    """Return legend entries of what `draw_detections` draws, with counts where `found` is given."""
    entries = (("found", style.HIT, 0.35), ("missed", style.MISSED, 0.6), ("false", style.FALSE, 0.2))
    counts = ("", "", "") if found is None else (found.found.sum(), (~found.found).sum(), (~found.hit).sum())
    return [
        Patch(facecolor=(colour, fill), edgecolor=colour, label=f"{count} {word}".strip())
        for count, (word, colour, fill) in zip(counts, entries, strict=True)
    ]
