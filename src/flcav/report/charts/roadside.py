"""Charts of roadside perception: recall against distance, and accuracy of fused labels against errors."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

ARM_COLOURS = (style.MUTED, style.SKY, style.BLUE)  # of the arms of a comparison, in their order
WIDTHS = (5.0, 3.0, 1.3)  # of their lines, so that coinciding lines are all visible


@style.styled
def draw_recall(
    edges_m: Sequence[float], lines: Mapping[str, Sequence[float | None]], unseen: Sequence[str], within_m: float
) -> Figure:
    """Return recall against distance, a line per town: shares in intervals between `edges_m` [m], None without cars.

    Lines of towns in `unseen` are solid, others dotted; a vertical line marks `within_m` [m].
    """
    figure = style.canvas(6.4, 3.4)
    axes = figure.subplots()
    middle = (np.array(edges_m[:-1]) + np.array(edges_m[1:])) / 2
    colours = iter(style.OTHER_COLOURS)
    for town, shares in lines.items():
        values = np.array([np.nan if share is None else share for share in shares])
        colour = style.TOWN_COLOURS.get(town) or next(colours)
        solid = town in unseen
        label = town if solid else f"{town} (trained there)"
        axes.plot(middle, values, "o-" if solid else "o:", color=colour, markersize=4, label=label)
    axes.axvline(within_m, color=style.RULE, linewidth=1)
    axes.set(xlim=(0, within_m + 1), ylim=(0, 1.02), xlabel="distance from the pole [m]", ylabel="recall")
    axes.grid(axis="y")
    style.key(figure, axes.get_lines()[: len(lines)], ncols=min(len(lines), 3))
    return figure


@style.styled
def draw_errors(panels: Mapping[str, Mapping[str, Sequence[tuple[float, float, float, float]]]]) -> Figure:
    """Return AP50 against the size of an error, with a panel per kind of error and a line per arm.

    A point is (size, mean, least, greatest over seeds).
    """
    columns = 3
    rows = -(-len(panels) // columns)
    figure = style.canvas(3.1 * columns, 2.4 * rows + 0.4)
    drawn = np.atleast_1d(figure.subplots(rows, columns, sharey=True)).ravel()
    for axes in drawn[len(panels) :]:
        axes.remove()
    for number, (axes, (title, arms)) in enumerate(zip(drawn, panels.items())):
        for (arm, points), colour, width in zip(arms.items(), ARM_COLOURS, WIDTHS, strict=True):
            size, mean, low, high = np.array(points).T
            axes.fill_between(size, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(size, mean, "o-", color=colour, linewidth=width, markersize=width + 2.5, label=arm)
        axes.set_xlabel(title)
        axes.grid(axis="y")
        if number % columns == 0:
            axes.set_ylabel("AP50 of the labels")
    style.key(figure, list(drawn[0].get_lines()))
    return figure


@style.styled
def draw_ranges(edges_m: Sequence[float], shares: Mapping[str, Sequence[float | None]]) -> Figure:
    """Return recall against distance, a line per sensor: shares in intervals of `edges_m` [m], None without cars."""
    figure = style.canvas(6.4, 3.6)
    axes = figure.subplots()
    middle = (np.array(edges_m[:-1]) + np.array(edges_m[1:])) / 2
    colours = (style.SKY, style.GREEN, style.BLUE, style.INK, style.ORANGE, style.VERMILLION)
    for number, (name, recall) in enumerate(shares.items()):
        drawn = np.array([np.nan if share is None else share for share in recall])
        axes.plot(middle, drawn, "o-", color=colours[number % len(colours)], markersize=4, label=name)
    axes.set(xlim=(0, edges_m[-1]), ylim=(0, 1.02), xlabel="distance from the pole [m]", ylabel="share of cars found")
    axes.grid(axis="y")
    style.key(figure, axes.get_lines())
    return figure
