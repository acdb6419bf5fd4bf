"""Chart of accuracy and leakage against noise: a line for each, with intervals over seeds."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from flcav.report import style
from flcav.statistics.seeds import MeanOverSeeds

COLOURS = (style.BLUE, style.VERMILLION, style.ORANGE, style.PURPLE)
NAME_HEIGHT = 0.07  # of the axes: a line of text


@style.styled
def draw_leakage(levels: Sequence[str], lines: Mapping[str, Sequence[MeanOverSeeds]]) -> Figure:
    """Return the figure of shares in [0, 1], a line for each name; `levels` are the ticks' texts, noise and epsilon."""
    figure = style.canvas(8.6, 3.9)
    axes = figure.add_subplot()
    ends = style.keep_apart([line[0].mean for line in lines.values()], NAME_HEIGHT, 1.03)
    for (name, line), colour, end in zip(lines.items(), COLOURS, ends, strict=True):
        axes.plot(range(len(levels)), [each.mean for each in line], "o-", color=colour, markersize=4)
        for x, each in enumerate(line):
            if each.low is not None and each.high is not None:
                axes.plot([x, x], [each.low, each.high], color=colour, linewidth=1)
        axes.annotate(name, (-0.15, end), color=colour, va="center", ha="right", fontsize=style.SMALL)
    axes.axhline(0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set_xticks(range(len(levels)), levels)
    axes.set(xlabel="noise of each vehicle, as a multiple of the clipping norm; below: ε", ylim=(-0.02, 1.04))
    axes.set_xlim(-3.4, len(levels) - 0.7)
    axes.spines["left"].set_visible(False)
    axes.yaxis.tick_right()
    axes.grid(axis="y")
    return figure
