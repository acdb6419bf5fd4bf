"""Chart of accuracy against the bytes of the uplink: an arm of a comparison of exchanges is a point."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flcav.intervals import MeanOverSeeds
from flcav.report import style

COLOURS = (style.INK, style.BLUE, style.ORANGE, style.GREEN, style.VERMILLION)  # in the order of the groups
LINE = 0.046  # height of a line of text, of the axes
NEAR = 1.35  # factor of the uplink within which names stand in one column
DODGE = 1.035  # factor between points of a column, so that their intervals can be told apart


@dataclass(frozen=True)
class Mark:
    """An arm: its group, megabytes sent upwards by wireless, and its accuracy."""

    group: str
    name: str
    up_mb: float  # 0: nothing is sent; a line across
    accuracy: MeanOverSeeds


@style.styled
def draw_exchanges(marks: Sequence[Mark]) -> Figure:
    """Return the figure of accuracy, with 95 % intervals over seeds, against the uplink on a logarithmic axis."""
    figure = style.canvas(8.6, 5.4)
    axes = figure.add_subplot()
    axes.set_xscale("log")
    colours = dict(zip(dict.fromkeys(mark.group for mark in marks), COLOURS, strict=False))
    sent = sorted((mark for mark in marks if mark.up_mb > 0), key=lambda mark: (mark.up_mb, -mark.accuracy.mean))
    ends = [end for mark in marks for end in (mark.accuracy.low, mark.accuracy.high, mark.accuracy.mean) if end]
    low, high = min(ends) - 0.02, max(ends) + 0.02
    axes.set(ylim=(low, high), xlim=(sent[0].up_mb / 3, sent[-1].up_mb * 12))
    for mark in marks:
        if mark.up_mb == 0:
            axes.axhline(mark.accuracy.mean, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
            axes.annotate(mark.name, (0.01, mark.accuracy.mean), (0, 3), "axes fraction", color=style.MUTED)
    for column in _columns(sent):
        _draw_column(axes, column, colours, rightmost=column[-1] is sent[-1])
    for group, colour in colours.items():
        axes.plot([], [], "o", color=colour, markersize=5, label=group)
    axes.set(xlabel="wireless uplink of stages II and III, MB", ylabel="accuracy in the own region (95 % interval)")
    axes.grid(axis="y")
    style.key(figure, axes.get_legend_handles_labels()[0])
    return figure


def _columns(sent: Sequence[Mark]) -> Iterator[list[Mark]]:
    """Yield the marks, in ascending order of bytes, in columns of about the same bytes."""
    column: list[Mark] = []
    for mark in sent:
        if column and mark.up_mb > NEAR * column[0].up_mb:
            yield column
            column = []
        column.append(mark)
    yield column


def _draw_column(axes: Axes, column: Sequence[Mark], colours: Mapping[str, str], rightmost: bool) -> None:
    """Draw the points of a column, and their names beside it: on the right of the last one, else on the left."""
    low, high = axes.get_ylim()
    order = sorted(column, key=lambda mark: -mark.accuracy.mean)
    heights = style.keep_apart([mark.accuracy.mean for mark in order], LINE * (high - low), high)
    names_at = column[-1].up_mb * 1.9 if rightmost else column[0].up_mb / 1.25
    for place, (mark, height) in enumerate(zip(order, heights, strict=True)):
        x, mean, colour = mark.up_mb * DODGE ** (place - len(order) / 2), mark.accuracy.mean, colours[mark.group]
        if mark.accuracy.low is not None and mark.accuracy.high is not None:
            axes.plot([x, x], [mark.accuracy.low, mark.accuracy.high], color=colour, linewidth=1, alpha=0.6)
        axes.plot([x, names_at], [mean, height], color=colour, linewidth=0.5, alpha=0.5)
        axes.plot(x, mean, "o", color=colour, markersize=5)
        side = "left" if rightmost else "right"
        axes.annotate(mark.name, (names_at, height), color=colour, fontsize=style.SMALL, ha=side, va="center")
