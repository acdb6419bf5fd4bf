"""Charts of studies: confusion matrices, bars of average precision, final displacement errors, and costs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.report import style
from flcav.report.charts.runs import name_measure
from flcav.statistics.seeds import MeanOverSeeds

SHADES = LinearSegmentedColormap.from_list("shares", ["white", style.BLUE])
SIDE_IN, LABELS_IN = 3.6, 1.1
PANEL_IN, ROW_IN, HEAD_IN = 4.2, 0.27, 1.0
ABREAST = 3  # greatest number of panels side by side
PREDICTOR_COLOURS = (style.RULE, style.BLUE, style.SKY)
THICK = 0.26


@style.styled
def confusions(counts: Mapping[str, NDArray[np.int64]], classes: Sequence[str]) -> Figure:
    """Return confusion matrices, a panel per title; a cell is the share of the row's class predicted as the column's.

    `counts` are numbers of pictures (classes, classes) by title; a class without pictures is an empty row.
    """
    names = [name.replace("_", " ") for name in classes]
    figure = style.canvas(SIDE_IN * len(counts) + LABELS_IN, SIDE_IN + LABELS_IN)
    panels = np.atleast_1d(figure.subplots(1, len(counts), sharey=True))
    for axes, (title, matrix) in zip(panels, counts.items(), strict=True):
        shares = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
        axes.imshow(shares, cmap=SHADES, vmin=0, vmax=1)
        for row, column in np.argwhere(matrix > 0):
            share = shares[row, column]
            ink = "white" if share > 0.5 else style.INK
            place = {"ha": "center", "va": "center", "fontsize": style.SMALL - 1}
            axes.text(column, row, f"{100 * share:.0f}" if share >= 0.005 else "·", color=ink, **place)
        axes.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("found")
        axes.set_title(f"{title}: {np.trace(matrix) / matrix.sum():.1%} of {matrix.sum()}")
    panels[0].set_ylabel("recorded; % of the row")
    return figure


@dataclass(frozen=True)
class Bar:
    """A figure of a test, drawn as a bar with a dot per seed."""

    name: str
    mean: float  # over seeds
    seeds: tuple[float, ...]  # values by seed
    targets: int | None = None  # number of targets; None: a mean over the other bars


@style.styled
def precisions(panels: Mapping[str, Sequence[Bar]], label: str = "average precision at IoU 0.5") -> Figure:
    """Return a panel per title with a bar per figure and a dot per seed; axes span [0, 1] and all values.

    The label says what bars, dots and numbers in brackets are.
    """
    every = [value for bars in panels.values() for bar in bars for value in (bar.mean, *bar.seeds)]
    rows = max(len(bars) for bars in panels.values())
    columns = min(len(panels), ABREAST)
    lines = -(-len(panels) // columns)
    figure = style.canvas(PANEL_IN * columns, (HEAD_IN + ROW_IN * rows) * lines)
    drawn = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    for axes in drawn[len(panels) :]:
        axes.remove()
    for axes, (title, bars) in zip(drawn, panels.items()):
        for row, bar in enumerate(bars):
            axes.barh(row, bar.mean, height=0.7, color=style.BLUE if bar.targets is None else style.SKY)
            if bar.seeds:
                axes.plot(bar.seeds, [row] * len(bar.seeds), "o", color=style.INK, markersize=3, clip_on=False)
        names = [bar.name if bar.targets is None else f"{bar.name} ({bar.targets})" for bar in bars]
        axes.set_yticks(range(len(bars)), names)
        axes.set_ylim(rows - 0.4, -0.6)
        axes.set_xlim(min(0, *every), max(1, *every))
        axes.set_title(title)
        axes.grid(axis="x")
    every_bar = [bar for bars in panels.values() for bar in bars]
    seeds = max(len(bar.seeds) for bar in every_bar)
    told = [label, "bars: means", "dots: the seed" if seeds == 1 else f"dots: {seeds} seeds"]
    told += ["(n): targets"] * any(bar.targets is not None for bar in every_bar)
    figure.supxlabel("; ".join(told), fontsize=style.TEXT)
    return figure


@style.styled
def precision_table(panels: Mapping[str, Sequence[Bar]], label: str) -> Figure:
    """Return a table of means, darker where higher: a row per figure, a column per title, empty where a test lacks it.

    A cell has the mean, half the range over seeds where there are several, and below it the number of targets.
    """
    names = list(dict.fromkeys(bar.name for bars in panels.values() for bar in bars))
    figure = style.canvas(2.6 + 1.25 * len(panels), 0.8 + 0.42 * len(names))
    axes = figure.add_subplot()
    means = np.full((len(names), len(panels)), np.nan)
    for column, bars in enumerate(panels.values()):
        for bar in bars:
            row = names.index(bar.name)
            means[row, column] = bar.mean
            half = (max(bar.seeds) - min(bar.seeds)) / 2 if len(bar.seeds) > 1 else None
            look: dict[str, Any] = {"ha": "center", "color": "white" if bar.mean > 0.6 else style.INK}
            text = f"{bar.mean:.2f}" + ("" if half is None else f" ±{half:.2f}")
            axes.text(column, row - (0 if bar.targets is None else 0.17), text, va="center", **look)
            if bar.targets is not None:
                axes.text(column, row + 0.24, f"{bar.targets}", va="center", fontsize=style.SMALL, **look)
    axes.imshow(means, cmap=SHADES, vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(panels)), list(panels))
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(names)), names)
    axes.set_xticks(np.arange(-0.5, len(panels)), minor=True)
    axes.set_yticks(np.arange(-0.5, len(names)), minor=True)
    axes.grid(which="minor", color="white", linewidth=2)
    axes.tick_params(which="minor", length=0)
    axes.set_xlabel(label, loc="left")
    for spine in axes.spines.values():
        spine.set_visible(False)
    return figure


Panels = Mapping[str, Mapping[str, Sequence[Bar]]]  # bars by test and slice, named with its number of samples


@style.styled
def path_errors(panels: Panels) -> Figure:
    """Return a panel per test with the final displacement errors [m] of predictors by slice, and a dot per seed."""
    figure = style.canvas(8.6, 3.3)
    axes_of = figure.subplots(1, len(panels), sharex=True, squeeze=False)[0]
    for number, (axes, (test, slices)) in enumerate(zip(axes_of, panels.items(), strict=True)):
        _draw(axes, slices)
        axes.set_title(test)
        axes.set_xlabel("final error after 3 s [m]; dots: seeds")
        if number == 0:
            bars = next(iter(slices.values()))
            handles = [
                axes.barh([0], [0], color=colour, label=bar.name) for bar, colour in zip(bars, PREDICTOR_COLOURS)
            ]
            style.key(figure, handles)  # pyright: ignore[reportArgumentType]
    return figure


def _draw(axes: Axes, slices: Mapping[str, Sequence[Bar]]) -> None:
    for place, bars in enumerate(slices.values()):
        for number, (bar, colour) in enumerate(zip(bars, PREDICTOR_COLOURS, strict=True)):
            y = place + (number - 1) * (THICK + 0.02)
            axes.barh(y, bar.mean, THICK, color=colour)
            axes.plot(bar.seeds, [y] * len(bar.seeds), "o", markersize=3, color=style.INK, markeredgewidth=0)
            axes.annotate(
                f"{bar.mean:.2f}",
                (max(bar.mean, *bar.seeds), y),
                (5, 0),
                textcoords="offset points",
                va="center_baseline",
                fontsize=style.SMALL,
            )
    axes.set_yticks(range(len(slices)), list(slices))
    axes.invert_yaxis()
    axes.margins(x=0.14)


@style.styled
def costs(
    panels: Mapping[str, Mapping[str, tuple[float, MeanOverSeeds]]], cost: str, measure: str, front: Sequence[str]
) -> Figure:
    """Return a panel per title with a measure against its cost: points with intervals, joined along `front`.

    Points are numbered; below is what the numbers stand for, the same in all panels.
    """
    figure = style.canvas(PANEL_IN * len(panels), 3.9)
    for axes, (title, points) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        best = sorted((points[name][0], points[name][1].mean) for name in front)
        axes.plot(*zip(*best, strict=True), color=style.SKY, zorder=1)
        for name, (x, mean) in points.items():
            colour = style.BLUE if name in front else style.MUTED
            style.interval(axes, x, mean, color=colour, linewidth=1)
            axes.plot(x, mean.mean, "o", color=colour, markersize=5)
            text = str(list(points).index(name) + 1)
            axes.annotate(text, (x, mean.mean), (6, 0), textcoords="offset points", va="center", color=colour)
        axes.set_xlim(0, None)
        axes.set_xlabel(cost)
        axes.set_ylabel(name_measure(measure, (mean for _, mean in points.values())))
        axes.set_title(title)
        axes.grid(axis="y")
    names = [f"{number}: {name}" for number, name in enumerate(next(iter(panels.values())), start=1)]
    figure.supxlabel("      ".join(names), fontsize=style.SMALL)
    return figure
