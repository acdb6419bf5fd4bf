"""Charts of numbers: AP through the stages, megabytes per link, arms side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Patch

from flcav.report import style

Row = Mapping[str, Any]

STAGES = ("pretraining", "edge FL", "cloud FL")  # what `rounds` call them, in the order of a town's tested rows


def draw_ap_by_round(axes: Axes, rounds: Sequence[Row], stages: Sequence[Row]) -> None:
    """Draw AP50 after every round, a line per town, and the tested values with their intervals where stages end.

    `rounds` has rows stage, round, town, ap50, each town's in the order of the run; `stages` has one tested row for
    each of `STAGES` and town, a town's in that order.
    """
    known = {(row["stage"], row["round"]) for row in rounds}
    places = {key: x for x, key in enumerate(sorted(known, key=lambda key: (STAGES.index(key[0]), key[1])))}
    spans = _spans(places)
    tested_towns = list(dict.fromkeys(row["town"] for row in stages))
    for town in dict.fromkeys(row["town"] for row in rounds):
        colour = style.TOWN_COLOURS.get(town, style.GREEN)
        line = sorted((places[row["stage"], row["round"]], row["ap50"]) for row in rounds if row["town"] == town)
        axes.plot(*zip(*line, strict=True), color=colour, linewidth=1.6, marker="o", markersize=2.5)
        axes.annotate(town, line[-1], (9, 0), textcoords="offset points", color=colour, va="center", fontweight="bold")
    for number, town in enumerate(tested_towns):
        aside = 0.16 * (
            number - (len(tested_towns) - 1) / 2
        )  # so that intervals of several towns do not hide each other
        for stage, row in zip(STAGES, (row for row in stages if row["town"] == town), strict=True):
            if stage in spans:
                _draw_interval(axes, spans[stage][1] + aside, row, style.TOWN_COLOURS.get(town, style.GREEN))
    for stage, (start, end) in spans.items():
        if start > 0:
            axes.axvline(start - 0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
        axes.text((start + end) / 2, 1.02, stage, transform=axes.get_xaxis_transform(), ha="center")
    ends = {x: number for (_, number), x in places.items() if any(x in span for span in spans.values())}
    axes.set_xticks(list(ends), [str(number) for number in ends.values()])
    axes.set(xlabel="round of the stage", ylabel="AP50", ylim=(0, None), xlim=(-0.5, len(places) + 0.5))
    axes.grid(axis="y")


def _spans(places: Mapping[tuple[str, int], int]) -> dict[str, tuple[int, int]]:
    spans: dict[str, tuple[int, int]] = {}
    for (stage, _), x in places.items():
        spans[stage] = (spans.get(stage, (x, x))[0], x)
    return spans


def _draw_interval(axes: Axes, x: float, row: Row, colour: str) -> None:
    below, above = row["ap50"] - row["ap50_low"], row["ap50_high"] - row["ap50"]
    axes.errorbar(
        x, row["ap50"], [[below], [above]], fmt="o", color=colour, markersize=6, markeredgecolor="white", capsize=3
    )


def draw_megabytes(axes: Axes, ledger_by_stage: Sequence[Row], budgets: Mapping[str, float]) -> None:
    """Draw one stacked bar per link, a part per stage, against a line at the link's budget [MB]."""
    stages = list(dict.fromkeys(row["stage"] for row in ledger_by_stage))
    widest = max([*budgets.values(), *(row["mb"] for row in ledger_by_stage)])
    for y, (link, budget) in enumerate(budgets.items()):
        left = 0.0
        for stage, colour in zip(stages, style.STAGE_COLOURS, strict=False):
            sent = sum(row["mb"] for row in ledger_by_stage if (row["stage"], row["link"]) == (stage, link))
            axes.barh(y, sent, left=left, height=0.42, color=colour, edgecolor="white")
            if sent > 0.05 * widest:
                axes.text(left + sent / 2, y, f"{sent:.0f}", ha="center", va="center_baseline")
            left += sent
        axes.plot([budget, budget], [y - 0.34, y + 0.30], color=style.INK, linewidth=2)
        axes.text(budget, y - 0.37, f"{left:.0f} of {budget:.0f} MB", ha="right", va="bottom", fontsize=style.SMALL)
    patches = [Patch(color=colour, label=stage) for stage, colour in zip(stages, style.STAGE_COLOURS, strict=False)]
    style.key(axes.figure, patches)
    axes.set_yticks(range(len(budgets)), list(budgets))
    axes.set(xlabel="uplink megabytes (1 MB = 10⁶ bytes)", ylim=(len(budgets) - 0.6, -0.65))


def draw_arms(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw a forest plot: one line per row (arm, ap50, low, high), its interval and its number."""
    for y, row in enumerate(rows):
        axes.plot([row["low"], row["high"]], [y, y], color=style.BLUE, linewidth=2)
        axes.plot(row["ap50"], y, "s", color=style.BLUE, markersize=6)
        axes.annotate(
            f"{row['ap50']:.3f}", (1.0, y), (4, 0), xycoords=axes.get_yaxis_transform(), textcoords="offset points",
            va="center", fontsize=style.SMALL,
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), [row["arm"] for row in rows])
    axes.set(ylim=(len(rows) - 0.5, -0.5))
    axes.grid(axis="x")
