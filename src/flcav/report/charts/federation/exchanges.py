"""Chart of accuracy beside the bytes of the uplink: a row for each arm of a comparison of exchanges."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from flcav.report import style
from flcav.statistics.seeds import MeanOverSeeds

COLOURS = (
    style.INK,
    style.BLUE,
    style.ORANGE,
    style.GREEN,
    style.VERMILLION,
    style.PURPLE,
)  # in the order of the groups
ROW, GAP = 0.235, 0.6  # height of a row [inch], and between two groups [rows]


@dataclass(frozen=True)
class Mark:
    """An arm: its group, megabytes sent upwards by wireless, and accuracy in the own and in the unseen region."""

    group: str
    name: str
    up_mb: float  # 0: nothing is sent
    own: MeanOverSeeds
    unseen: MeanOverSeeds | None  # None: there is no such region


@style.styled
def draw_exchanges(marks: Sequence[Mark], measure: str) -> Figure:
    """Return the figure of a row per arm: its `measure`, with 95 % intervals over seeds, and the uplink on a log axis.

    A line across the accuracies marks the first arm that sends something, which the others are compared with.
    """
    groups = list(dict.fromkeys(mark.group for mark in marks))
    rows = [place + GAP * groups.index(mark.group) for place, mark in enumerate(marks)]
    figure = style.canvas(8.6, ROW * (rows[-1] + 1) + 0.9)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(5, 3))
    first = next(mark for mark in marks if mark.up_mb > 0)
    left.axvline(first.own.mean, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    for row, mark in zip(rows, marks, strict=True):
        colour = COLOURS[groups.index(mark.group) % len(COLOURS)]
        _draw_interval(left, row - 0.13, mark.own, colour, filled=True)
        if mark.unseen is not None:
            _draw_interval(left, row + 0.17, mark.unseen, colour, filled=False)
        if mark.up_mb > 0:
            right.plot(mark.up_mb, row, "o", color=colour, markersize=5)
            right.annotate(
                f"{mark.up_mb:.2g}" if mark.up_mb < 10 else f"{mark.up_mb:.0f}",
                (mark.up_mb, row),
                (6, 0),
                textcoords="offset points",
                va="center",
                fontsize=style.SMALL,
                color=style.MUTED,
            )
    left.set_yticks(rows, [mark.name for mark in marks])
    for label, mark in zip(left.get_yticklabels(), marks, strict=True):
        label.set_color(COLOURS[groups.index(mark.group) % len(COLOURS)])
    left.set_ylim(rows[-1] + 0.7, -0.7)
    shown = "own region ●" + (", unseen region ○" if any(mark.unseen for mark in marks) else "")
    left.set_xlabel(f"{measure} (95 % interval): {shown}")
    sent = [mark.up_mb for mark in marks if mark.up_mb > 0]
    right.set(xscale="log", xlabel="wireless uplink, stages II and III [MB]", xlim=(min(sent) / 1.6, max(sent) * 3))
    right.xaxis.set_major_formatter(FuncFormatter(lambda mb, _: f"{mb:g}"))
    right.xaxis.set_minor_formatter(NullFormatter())
    for axes in (left, right):
        axes.grid(axis="x")
        axes.spines["left"].set_visible(False)
    return figure


def _draw_interval(axes: Axes, row: float, mean: MeanOverSeeds, colour: str, filled: bool) -> None:
    if mean.low is not None and mean.high is not None:
        axes.plot([mean.low, mean.high], [row, row], color=colour, linewidth=1.2 if filled else 0.7)
    axes.plot(mean.mean, row, "o", color=colour, markersize=4.5, markerfacecolor=colour if filled else "white")
