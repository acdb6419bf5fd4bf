"""Map of what became of a network's errors in a town: gone, remaining and new, with what its roadside sensors see."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from flcav.arrays import Array, Mask
from flcav.report import style
from flcav.report.pictures.maps import HALO, draw_town
from flcav.world.line_of_sight import Viewshed, find_viewshed, find_visible_pairs
from flcav.world.map.town import Town

GONE, REMAINING, NEW = style.GREEN, style.ORANGE, style.VERMILLION
WIDTH_IN, TALLEST = 4.6, 1.25  # width of the map [inch], and its greatest height in widths
FALSE = "false_positive"


@dataclass(frozen=True)
class ErrorChanges:
    """Errors of a network in a town, those of a later network in the same frames, and what sensors on poles see."""

    town: Town
    errors: Array  # (E, 3) of the first network, world [m]
    kind: NDArray[np.str_]  # (E,)
    remains: Mask  # (E,) whether the later network makes the error, too
    seen: Mask  # (E,) whether a sensor sees the error past the houses
    new: Array  # (N, 3) errors of the later network alone, world [m]
    new_kind: NDArray[np.str_]  # (N,)
    poles: dict[str, Array]  # of all candidates (3,), world [m], by id
    viewsheds: dict[str, Viewshed]  # of the poles with a sensor, by id

    @property
    def gone(self) -> int:
        """The number of errors that the later network does not make."""
        return int((~self.remains).sum())


def look_from_poles(
    town: Town, poles: dict[str, Array], chosen: list[str], errors: Array, range_m: float
) -> tuple[dict[str, Viewshed], Mask]:
    """Return the viewsheds of chosen poles, and whether one of them sees each error (E, 3) within `range_m` [m].

    Houses and other things that stand in the town occlude, its traffic does not.
    """
    viewsheds = {name: find_viewshed(town, [], poles[name], range_m) for name in chosen}
    seen = np.zeros(len(errors), np.bool_)
    for name in chosen:
        near = np.flatnonzero(np.linalg.norm(errors - poles[name], axis=1) <= range_m)
        seen[near] |= find_visible_pairs(town, [], poles[name][None], errors, (np.zeros_like(near), near))
    return viewsheds, seen


@style.styled
def draw_changes(changes: ErrorChanges, width_in: float = WIDTH_IN) -> Figure:
    """Return the map with its legend, which has the counts."""
    x_low, y_low, x_high, y_high = changes.town.bounds
    figure = style.canvas(width_in, width_in * min((y_high - y_low) / (x_high - x_low), TALLEST) + 0.6)
    axes = figure.add_subplot()
    draw_changed(axes, changes)
    style.key(figure, list_key(changes), ncols=3, columnspacing=1.0)
    return figure


def draw_changed(axes: Axes, changes: ErrorChanges) -> None:
    """Draw the town, what the sensors see, the errors by what became of them, and the poles."""
    draw_town(axes, changes.town)
    for viewshed in changes.viewsheds.values():
        area = (viewshed.x, viewshed.y, gaussian_filter(viewshed.seen.astype(np.float64), 1.0))
        axes.contourf(*area, [0.5, 1.5], colors=[style.BLUE], alpha=0.22, zorder=1.5)
        axes.contour(*area, [0.5], colors=[style.BLUE], linewidths=0.9, zorder=1.6)
    _plot(axes, changes.errors[changes.remains], changes.kind[changes.remains], REMAINING, 4.5)
    _plot(axes, changes.errors[~changes.remains], changes.kind[~changes.remains], GONE, 5)
    _plot(axes, changes.new, changes.new_kind, NEW, 5)
    for name, (x, y, _) in changes.poles.items():
        if name in changes.viewsheds:
            axes.plot(x, y, "o", markersize=13, color=style.BLUE, markeredgecolor="white", zorder=9)
            axes.text(x, y, name, ha="center", va="center_baseline", color="white", fontsize=style.SMALL, zorder=10)
        else:
            axes.plot(x, y, "o", markersize=4, color="white", markeredgecolor=style.INK, zorder=7)
            look = {"fontsize": style.SMALL, "color": style.MUTED, "path_effects": HALO, "zorder": 8}
            axes.annotate(name, (x, y), (4, 3), textcoords="offset points", **look)


def _plot(axes: Axes, at: Array, kind: NDArray[np.str_], colour: str, size: float) -> None:
    """Plot errors: a filled circle for a missed object, a cross for a false positive, a triangle for others."""
    known = {"miss": "o", FALSE: "x"}
    for name in dict.fromkeys(kind.tolist()):
        marker = known.get(name, "^")
        edge: dict[str, Any] = {"markeredgewidth": 1.6}
        edge = edge if marker == "x" else {"markeredgecolor": "white", "markeredgewidth": 0.5}
        here = at[kind == name, :2]
        axes.plot(*here.T, marker, linestyle="none", markersize=size, color=colour, zorder=6, **edge)


def list_key(changes: ErrorChanges) -> list[Line2D | Patch]:
    """Return the legend of `draw_changed`, with counts."""
    dot = {"linestyle": "none", "marker": "o", "markersize": 6}
    counts = {GONE: f"{changes.gone} gone", REMAINING: f"{changes.remains.sum()} left", NEW: f"{len(changes.new)} new"}
    entries: list[Line2D | Patch] = [Line2D([], [], color=colour, label=text, **dot) for colour, text in counts.items()]
    kinds = {*changes.kind.tolist(), *changes.new_kind.tolist()}
    shapes = [("o", "missed", "miss"), ("x", "false", FALSE)]
    shapes = [(marker, word) for marker, word, kind in shapes if kind in kinds]
    if len(shapes) > 1:
        entries += [Line2D([], [], color=style.MUTED, label=word, **{**dot, "marker": mark}) for mark, word in shapes]
    if changes.viewsheds:
        entries.append(Patch(facecolor=(style.BLUE, 0.22), edgecolor=style.BLUE, label="seen from the pole"))
    return entries
