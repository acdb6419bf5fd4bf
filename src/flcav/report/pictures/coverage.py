"""Map of a town's radio coverage: rate by place, areas without line of sight, units, and drives of vehicles."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.network.radio.budget import PathState
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import Coverage
from flcav.report import style
from flcav.report.pictures.maps import HALO
from flcav.world.map.town import Town

Array = NDArray[np.float64]

STEPS = 8  # number of colours of the rate
MARKS: dict[PathState, tuple[str, dict[str, Any]]] = {
    PathState.LOS: ("line of sight", {"color": "white", "markeredgecolor": style.INK}),
    PathState.NLOSV: ("behind a vehicle", {"color": style.ORANGE, "markeredgecolor": style.INK}),
    PathState.NLOS: ("behind buildings", {"color": style.INK, "markeredgecolor": "white"}),
}
HATCH = "////"
EVERY_S = 2.0  # between two marks of a drive


@style.styled
def coverage_map(town: Town, coverage: Coverage, paths: Array | None = None, links: RadioLinks | None = None) -> Figure:
    """Return the map of a town coloured by rate, with the units and, if given, the drives of vehicles.

    `paths` (T, V, 2) [m, world] belong to `links`; marks show the state of the link to the unit of least loss.
    """
    x_low, y_low, x_high, y_high = town.bounds
    figure = style.canvas(7.2, 7.2 * (y_high - y_low) / (x_high - x_low) + 0.8)
    axes = figure.add_subplot()
    colours, norm = _draw_rates(axes, coverage)
    _draw_streets(axes, town)
    if paths is not None and links is not None:
        _draw_drives(axes, paths, links)
    for name, (x, y, _) in zip(coverage.unit, coverage.site):
        axes.plot(x, y, "o", markersize=15, color=style.VERMILLION, markeredgecolor="white", zorder=6)
        look = {"ha": "center", "va": "center_baseline", "fontsize": style.SMALL, "color": "white", "zorder": 7}
        axes.text(x, y, name.removeprefix("pole"), fontweight="bold", **look)
    axes.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal")
    style.hide_axes(axes)
    style.scale_bar(axes, 50)
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, location="bottom", fraction=0.03, pad=0.01, aspect=60)
    bar.set_label("rate of a vehicle alone in the band [Mbit/s]")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    handles: list[Artist] = [
        Line2D([], [], linestyle="", marker="o", markersize=10, color=style.VERMILLION, label="unit")
    ]
    handles.append(Patch(facecolor="none", edgecolor=style.MUTED, hatch=HATCH, label="no line of sight"))
    if links is not None:
        handles += [Line2D([], [], linestyle="", marker="o", label=label, **look) for label, look in MARKS.values()]
    style.key(figure, handles)
    return figure


def _draw_rates(axes: Axes, coverage: Coverage) -> tuple[ListedColormap, BoundaryNorm]:
    """Draw the rates, hatched without line of sight; return the colours and their norm [Mbit/s]."""
    rate = coverage.rate_bps / 1e6
    levels = np.linspace(0.0, max(float(np.ceil(rate.max())), 1.0), STEPS + 1)
    colours = ListedColormap(colormaps["YlGnBu"](np.linspace(0.05, 0.85, STEPS)))
    norm = BoundaryNorm(levels.tolist(), STEPS)
    axes.pcolormesh(coverage.x, coverage.y, rate, cmap=colours, norm=norm, shading="nearest", rasterized=True)
    hidden = (coverage.state == PathState.NLOS).astype(np.float64)
    if hidden.any():
        area = axes.contourf(coverage.x, coverage.y, hidden, levels=[0.5, 1.5], colors="none", hatches=[HATCH])
        area.set(edgecolor="#ffffff90", linewidth=0.0, hatch_linewidth=0.6)
    if 0 < hidden.mean() < 1:
        axes.contour(coverage.x, coverage.y, hidden, levels=[0.5], colors="white", linewidths=1.0)
    return colours, norm


def _draw_streets(axes: Axes, town: Town) -> None:
    """Draw the kerbs and the buildings over the rates."""
    axes.add_collection(LineCollection(list(town.kerbs), colors=style.INK, linewidths=0.7, alpha=0.7, zorder=3))
    x, y, yaw, length, width, height = town.buildings.T
    houses = Boxes.from_array(np.c_[x, y, height / 2, length, width, height, yaw], "building")
    look = {"facecolor": style.BUILDING, "edgecolor": "white", "linewidth": 0.4, "zorder": 4}
    axes.add_collection(PolyCollection(list(houses.corners()[:, :4, :2]), **look))


def _draw_drives(axes: Axes, paths: Array, links: RadioLinks) -> None:
    """Draw the drives, with a mark every `EVERY_S` by the state of the link."""
    best = links.loss_db.argmin(axis=2)
    state = np.take_along_axis(links.state, best[..., None], 2)[..., 0]  # (T, V)
    slots = np.floor((links.time_s - links.time_s[0]) / EVERY_S)
    marked = np.flatnonzero(np.diff(slots, prepend=-1.0) > 0)
    for v, vehicle in enumerate(links.vehicle):
        axes.plot(*paths[:, v].T, color=style.INK, linewidth=1.0, alpha=0.6, zorder=5)
        for path_state, (_, look) in MARKS.items():
            rows = marked[state[marked, v] == path_state]
            axes.plot(*paths[rows, v].T, "o", markersize=5, markeredgewidth=0.7, zorder=5, **look)
        first = np.flatnonzero(links.present[:, v])
        if len(first):
            x, y = paths[first[0], v]
            text = {"textcoords": "offset points", "fontsize": style.SMALL, "path_effects": HALO, "zorder": 7}
            axes.annotate(vehicle, (x, y), (6, 6), **text)
