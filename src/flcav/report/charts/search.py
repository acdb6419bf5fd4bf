"""Chart of a search: how what was found grows with the frames that were tested."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.report import style

COLOURS = (style.MUTED, style.BLUE, style.ORANGE)


@style.styled
def draw_growth(lines: Mapping[str, NDArray[np.int64]], frames: float) -> Figure:
    """Return distinct failures (seeds, scenarios) of each rule against tested frames, `frames` of each scenario."""
    figure = style.canvas(6.0, 3.4)
    axes = figure.subplots()
    for (name, found), colour in zip(lines.items(), COLOURS):
        at = frames * np.arange(1, found.shape[1] + 1)
        axes.plot(at, found.mean(axis=0), color=colour, label=name)
        axes.fill_between(at, found.min(axis=0), found.max(axis=0), color=colour, alpha=0.2, linewidth=0)
    axes.set(xlabel="frames tested", ylabel="distinct failures")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.grid(axis="y")
    style.key(figure, axes.get_lines())
    return figure
