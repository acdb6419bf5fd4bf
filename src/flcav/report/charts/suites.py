"""Chart of registered LiDAR suites: their clouds together, as calibrated and as registered, and what they find."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.report import style

SUITE_COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
ARM_COLOURS = (style.MUTED, style.ORANGE, style.BLUE)
BAND_M = (-5.2, 0.5)  # heights about the first suite's LiDAR that are drawn: walls and trees, without the ground
VIEW_M = (-22.0, 62.0, -48.0, 36.0)  # x and y about the first suite
CLOSE_M = 6.0  # half the edge of the close-up


@dataclass(frozen=True)
class Shown:
    """The clouds of all suites in the frame of the first one."""

    title: str
    clouds: Sequence[NDArray]  # (N, 3) each
    places: Sequence[NDArray]  # (3,) of each suite


@style.styled
def draw_suites(
    shown: Sequence[Shown],
    names: Sequence[str],
    edges_m: Sequence[float],
    shares: Mapping[str, Sequence[float | None]],
) -> Figure:
    """Return the figure: a map of the clouds for each of `shown`, with a close-up below; recall against distance.

    shares: by arm, in the intervals between `edges_m`; None where there is nothing to find.
    """
    figure = style.canvas(9.6, 6.4)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.25, 1))
    corner = _choose_corner(shown[-1].clouds)
    for column, each in enumerate(shown):
        wide, near = figure.add_subplot(grid[0, column]), figure.add_subplot(grid[1, column])
        for cloud, colour in zip(each.clouds, SUITE_COLOURS, strict=True):
            own = cloud[(cloud[:, 2] > BAND_M[0]) & (cloud[:, 2] < BAND_M[1])]
            wide.plot(*own[:, :2].T, ".", color=colour, markersize=0.7, markeredgewidth=0)
            near.plot(*own[:, :2].T, ".", color=colour, markersize=2.2, markeredgewidth=0)
        for number, ((x, y, _), colour) in enumerate(zip(each.places, SUITE_COLOURS, strict=True), start=1):
            wide.plot(x, y, "o", markersize=12, color=colour, markeredgecolor="white")
            wide.text(x, y, str(number), color="white", ha="center", va="center_baseline", fontsize=style.SMALL)
        wide.set(xlim=VIEW_M[:2], ylim=VIEW_M[2:], aspect="equal", title=each.title)
        x, y = corner
        near.set(xlim=(x - CLOSE_M, x + CLOSE_M), ylim=(y - CLOSE_M, y + CLOSE_M), aspect="equal", title="close-up")
        wide.plot(*_square(x, y), color=style.INK, linewidth=1)
        for axes, bar_m in ((wide, 20), (near, 5)):
            style.hide_axes(axes)
            style.scale_bar(axes, bar_m)
    axes, below = figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])
    middle = (np.array(edges_m[:-1]) + np.array(edges_m[1:])) / 2
    for (arm, values), colour in zip(shares.items(), ARM_COLOURS, strict=True):
        drawn = np.array([np.nan if value is None else value for value in values])
        axes.plot(middle, drawn, "o-", color=colour, markersize=4, label=arm)
    axes.set(
        ylim=(0, 1.02), xlim=(0, edges_m[-1]), xlabel="distance from the first suite [m]", title="share of cars found"
    )
    axes.grid(axis="y")
    below.legend(handles=axes.get_lines(), loc="upper left", frameon=False)  # curves fill the axes themselves
    style.hide_axes(below)
    handles = [
        axes.plot([], [], "o", color=colour, label=f"{number}: {name}")[0]
        for number, (name, colour) in enumerate(zip(names, SUITE_COLOURS, strict=True), start=1)
    ]
    style.key(figure, handles)
    return figure


def _choose_corner(clouds: Sequence[NDArray]) -> tuple[float, float]:
    """Return the place x, y in view where the clouds of most suites, and most of their points, come together."""
    counts = []
    for cloud in clouds:
        own = cloud[(cloud[:, 2] > BAND_M[0]) & (cloud[:, 2] < BAND_M[1])]
        counts.append(np.histogram2d(*own[:, :2].T, bins=(14, 14), range=(VIEW_M[:2], VIEW_M[2:]))[0])
    common = np.sort(np.stack(counts), axis=0)[-2]  # of the suite with second most points
    row, column = np.unravel_index(int(common.argmax()), common.shape)
    step = (VIEW_M[1] - VIEW_M[0]) / 14, (VIEW_M[3] - VIEW_M[2]) / 14
    return VIEW_M[0] + (row + 0.5) * step[0], VIEW_M[2] + (column + 0.5) * step[1]


def _square(x: float, y: float) -> tuple[NDArray, NDArray]:
    ends = np.array((-CLOSE_M, CLOSE_M, CLOSE_M, -CLOSE_M, -CLOSE_M))
    return x + ends, y + np.roll(ends, 1)
