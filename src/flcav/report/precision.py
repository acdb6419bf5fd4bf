"""Average precision, and other numbers, as bars: of the whole, of parts of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from flcav.report import style

PANEL_IN, ROW_IN, HEAD_IN = 4.2, 0.27, 0.9
ABREAST = 3  # panels side by side, at most


@dataclass(frozen=True)
class Bar:
    """One number of a test."""

    name: str
    mean: float  # over seeds
    seeds: tuple[float, ...]  # one each
    targets: int | None = None  # how many there were to find; None: all of the others


@style.styled
def precisions(panels: Mapping[str, Sequence[Bar]], label: str = "average precision at IoU 0.5") -> Figure:
    """Return a panel per title: a bar for each number, a dot for each seed, from 0 to 1 where all are within."""
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
            axes.plot(bar.seeds, [row] * len(bar.seeds), "o", color=style.INK, markersize=3, clip_on=False)
        names = [bar.name if bar.targets is None else f"{bar.name} ({bar.targets})" for bar in bars]
        axes.set_yticks(range(len(bars)), names)
        axes.set_ylim(rows - 0.4, -0.6)
        axes.set_xlim(min(0, *every), max(1, *every))
        axes.set_xlabel(label)
        axes.set_title(title)
        axes.grid(axis="x")
    return figure
