"""Charts of plans: megabytes by link, objective against budget, and predicted against realised scores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flcav.optimization.allocation.budget_sweep import BudgetPoint
from flcav.report import style
from flcav.report.charts.figures import WIDTH
from flcav.statistics.seeds import MeanOverSeeds

TASKS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.VERMILLION, style.RULE)
SHADES = {"samples": 1.0, "edge rounds": 0.62, "cloud rounds": 0.32}  # opacity by stage
LINKS = {"both links": style.RULE, "wireless alone": style.BLUE, "wireline alone": style.VERMILLION}
PLAN_COLOURS = {"equal-stages": style.ORANGE, "joint": style.BLUE}
PLAN_NAMES = {"equal-stages": "equal stages", "joint": "joint plan"}
STAGES = {"pretrain": "pretrained", "edge": "edge FL", "cloud": "edge +\ncloud FL"}
ASIDE = 0.07  # offset that keeps intervals of two plans apart


class StageTraffic(TypedDict):
    """Traffic of a task on a link in one stage."""

    link: str
    task: str
    stage: str
    mb: float


@style.styled
def megabytes(parts: Sequence[StageTraffic], links: Mapping[str, Mapping[str, float]]) -> Figure:
    """Return a stacked bar per link, with parts by task (colour) and stage (shade), against the budget [MB]."""
    tasks = list(dict.fromkeys(row["task"] for row in parts))
    colours = dict(zip(tasks, TASKS, strict=False))
    figure = style.canvas(WIDTH, 0.72 * WIDTH + 0.1 * len(tasks))
    axes = figure.add_subplot()
    widest = max(link["budget_mb"] for link in links.values())
    for y, (name, link) in enumerate(links.items()):
        left = 0.0
        for row in sorted(parts, key=lambda part: tasks.index(part["task"])):
            if row["link"] != name or not row["mb"]:
                continue
            shade = {"color": colours[row["task"]], "alpha": SHADES[row["stage"]]}
            axes.barh(y, row["mb"], left=left, height=0.44, edgecolor="white", linewidth=1.0, **shade)
            if row["mb"] > 0.09 * widest:
                ink = "white" if row["stage"] == "samples" and row["task"] == tasks[0] else style.INK
                place = {"ha": "center", "va": "center_baseline", "fontsize": style.SMALL}
                axes.text(left + row["mb"] / 2, y, f"{row['mb']:,.0f}", color=ink, **place)
            left += row["mb"]
        axes.plot([link["budget_mb"]] * 2, [y - 0.32, y + 0.32], color=style.INK, linewidth=2)
        note = f"{left:,.0f} of {link['budget_mb']:,.0f} MB"
        axes.text(link["budget_mb"], y - 0.36, note, ha="right", va="bottom", fontsize=style.SMALL)
    handles = [Patch(color=colour, label=task) for task, colour in colours.items()]
    handles += [Patch(color=style.INK, alpha=shade, label=stage) for stage, shade in SHADES.items()]
    style.key(figure, handles, ncols=2)
    axes.set_yticks(range(len(links)), list(links))
    axes.set(xlabel="uplink megabytes (1 MB = 10⁶ bytes)", ylim=(len(links) - 0.6, -0.75))
    return figure


@style.styled
def best_by_budget(sweep: Mapping[str, Sequence[BudgetPoint]], measure: str) -> Figure:
    """Return the optimal objective, named `measure`, against the budgets, scaled together and one at a time."""
    figure = style.canvas(WIDTH, 0.8 * WIDTH)
    axes = figure.add_subplot()
    widths = dict(zip(LINKS, (5.0, 1.6, 1.6), strict=True))  # so that coinciding lines are both visible
    for name, colour in LINKS.items():
        points = sweep[name]
        line = {"color": colour, "linewidth": widths[name], "marker": "o", "markersize": widths[name] + 1.5}
        axes.plot([p.factor for p in points], [p.objective for p in points], **line)
    now = [p.objective for p in sweep["both links"] if p.factor == 1]
    axes.plot([1] * len(now), now, "o", color=style.INK, markersize=8, markeredgecolor="white")
    axes.annotate("this plan", (1, now[0]), (8, 8), textcoords="offset points", fontweight="bold")
    style.key(
        figure,
        [Line2D([], [], color=colour, linewidth=widths[name], label=name) for name, colour in LINKS.items()],
        columnspacing=1.0,
    )
    axes.set(xlabel="budget, as a multiple of this one", ylabel=measure)
    axes.grid(axis="y")
    return figure


@dataclass(frozen=True)
class StageReached:
    """A figure after a stage: prediction, mean over seeds with its interval, and values by seed."""

    predicted: float
    trained: MeanOverSeeds
    seeds: tuple[float, ...]


ByStage = Mapping[str, StageReached]  # by `STAGES`


@dataclass(frozen=True)
class PlansReached:
    """AP50 after each stage, by plan, and the paired differences of the two plans."""

    ap: Mapping[str, ByStage]
    differences: ByStage


@style.styled
def predicted_and_realised(budgets: Mapping[str, PlansReached], place: str) -> Figure:
    """Return AP50 of both plans after each stage in `place`, predicted and trained, and their paired differences.

    There is a row of axes for each of `budgets`, by name.
    """
    figure = style.canvas(9.0, 0.6 + 3.3 * len(budgets))
    rows = figure.subplots(len(budgets), 2, width_ratios=(3, 2), squeeze=False, sharey="col")
    for (name, plans), (left, right) in zip(budgets.items(), rows, strict=True):
        _draw_ap(left, plans.ap, f"budgets {name}: AP50, {place}")
        _draw_differences(right, plans.differences)
    handles = [
        Line2D([], [], color=colour, marker="o", label=PLAN_NAMES[name]) for name, colour in PLAN_COLOURS.items()
    ]
    handles += [
        Line2D([], [], color=style.MUTED, linestyle=(0, (3, 2)), marker="D", mfc="white", label="predicted"),
        Line2D([], [], color=style.MUTED, marker="o", label="trained: mean, 95 % over seeds"),
        Line2D([], [], color=style.MUTED, linestyle="", marker=".", label="one seed"),
    ]
    style.key(figure, handles)
    return figure


def _draw_ap(axes: Axes, ap: Mapping[str, ByStage], title: str) -> None:
    for side, (name, colour) in zip((-ASIDE, ASIDE), PLAN_COLOURS.items(), strict=True):
        places = [number + side for number in range(len(STAGES))]
        reached = [ap[name][stage] for stage in STAGES]
        predicted = [figures.predicted for figures in reached]
        axes.plot(places, predicted, color=colour, linestyle=(0, (3, 2)), marker="D", mfc="white")
        axes.plot(places, [figures.trained.mean for figures in reached], color=colour, marker="o", linewidth=1.8)
        for place, figures in zip(places, reached, strict=True):
            style.interval(axes, place, figures.trained, color=colour, linewidth=1)
            for seed in figures.seeds:
                axes.plot(place, seed, ".", color=colour, alpha=0.5)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title(title, fontweight="bold")
    axes.grid(axis="y")


def _draw_differences(axes: Axes, differences: ByStage) -> None:
    for place, stage in enumerate(STAGES):
        figures = differences[stage]
        style.interval(axes, place, figures.trained, color=style.INK, linewidth=1.2)
        axes.plot(place, figures.trained.mean, "o", color=style.INK)
        axes.plot(place - ASIDE, figures.predicted, "D", color=style.MUTED, mfc="white")
        for seed in figures.seeds:
            axes.plot(place + ASIDE, seed, ".", color=style.MUTED)
    axes.axhline(0, color=style.MUTED, linewidth=0.8)
    axes.set_xticks(range(len(STAGES)), list(STAGES.values()))
    axes.set_title("joint plan minus equal stages", fontweight="bold")
    axes.grid(axis="y")
