"""Charts of runs: a measure after every round, megabytes by link, and a forest plot of arms."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator
from matplotlib.transforms import offset_copy

from flcav.interface.wording import describe_megabytes
from flcav.report import style
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN
from flcav.runs.results.run import ArmCost
from flcav.runs.results.table import Row
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.storage.records import select

LINE, TALL = 0.07, 0.13  # height of a name as a fraction of the axis: in charts of rounds, and of tests
STAGES = {PRETRAIN: "pretraining", EDGE: "edge FL", CLOUD: "cloud FL"}  # in their order


def draw_by_round(axes: Axes, rounds: Sequence[Row], measure: str) -> None:
    """Draw the measure on validation frames after every round, a line per town.

    `rounds` are the validation scores of `tabulate`. Round 0 is the pretrained network, before round 1 of edge FL. All
    stages have the same width.
    """
    places = _places(rounds)
    lines = {
        town: sorted((places[_stage_of(row)][row.round or 0], row.value) for row in select(rounds, region=town))
        for town in dict.fromkeys(row.region for row in rounds)
    }
    colours = {town: _colour(town, lines) for town in lines}
    for town, line in lines.items():
        axes.plot(*zip(*line, strict=True), color=colours[town], linewidth=1.6, marker="o", markersize=2.5)
    axes.set_ylim(0, None)
    _name_ends(axes, {town: line[-1] for town, line in lines.items()}, colours, LINE)
    _mark_stages(axes, places)
    axes.set(xlabel="round of the stage, validation frames", ylabel=measure)
    axes.grid(axis="y")


def draw_tested(axes: Axes, tested: Sequence[Row], measure: str, name_height: float = TALL) -> None:
    """Draw the measure on test frames with its interval after every stage, a colour per town.

    `tested` are rows of `tabulate`, one per stage and region; `name_height`: of a name, in axes.
    """
    stages = [stage for stage in STAGES if select(tested, stage=stage)]
    towns = list(dict.fromkeys(row.region for row in tested))
    ends = {}
    colours = {town: _colour(town, towns) for town in towns}
    for number, town in enumerate(towns):
        aside = 0.5 + 0.12 * (number - (len(towns) - 1) / 2)  # keeps intervals of towns apart
        reached = {stages.index(row.stage) + aside: row.estimate for row in select(tested, region=town)}
        points = sorted((x, estimate.mean) for x, estimate in reached.items())
        axes.plot(*zip(*points, strict=True), color=colours[town], linewidth=0.8, linestyle=(0, (2, 2)))
        for x, estimate in reached.items():
            _draw_interval(axes, x, estimate, colours[town])
        ends[town] = points[-1]
    axes.set(xlim=(0, max(len(stages), 1) + 0.12), xlabel="test frames, with 95 % intervals", ylabel=measure)
    axes.set_ylim(0, None)
    _name_ends(axes, ends, colours, name_height)
    axes.set_xticks([place + 0.5 for place in range(len(stages))], [STAGES[stage] for stage in stages])
    axes.grid(axis="y")


def name_measure(measure: str, estimates: Iterable[Estimate]) -> str:
    """Return the label of an axis of means with intervals, such as "AP50 (mean of 8 seeds, 95 % interval)"."""
    counts = sorted({estimate.seeds for estimate in estimates if isinstance(estimate, MeanOverSeeds)})
    if not counts or counts[-1] == 1:
        return f"{measure} (95 % interval)"
    seeds = f"{counts[-1]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    return f"{measure} (mean of {seeds} seeds, 95 % interval)"


def _name_ends(
    axes: Axes,
    ends: Mapping[str, tuple[float, float]],
    colours: Mapping[str, str],
    height: float,
    column: Callable[[float], float] = int,
) -> None:
    """Write the name of each line next to its end (x, y), without overlaps within a column of x, such as a stage.

    A thin line joins the end with its name.
    """
    low, top = axes.get_ylim()
    for at in dict.fromkeys(column(x) for x, _ in ends.values()):
        near = {name: end for name, end in ends.items() if column(end[0]) == at}
        right = max(x for x, _ in near.values())
        places = style.keep_apart([y for _, y in near.values()], height * (top - low), top)
        aside = offset_copy(axes.transData, axes.figure.get_figure(root=True), x=13, y=0, units="points")
        for (name, end), place in zip(near.items(), places, strict=True):
            line = {"arrowstyle": "-", "color": colours[name], "linewidth": 0.7, "shrinkA": 0, "shrinkB": 3}
            look: dict[str, Any] = {"color": colours[name], "va": "center", "fontweight": "bold", "arrowprops": line}
            axes.annotate(name, end, (right, place), textcoords=aside, annotation_clip=False, **look)


def _colour(town: str, towns: Iterable[str]) -> str:
    """Return the colour of a town: that of `style.TOWN_COLOURS`, or else the next of `style.OTHER_COLOURS`."""
    others = [name for name in dict.fromkeys(towns) if name not in style.TOWN_COLOURS]
    return style.TOWN_COLOURS.get(town) or style.OTHER_COLOURS[others.index(town) % len(style.OTHER_COLOURS)]


def _places(rounds: Sequence[Row]) -> dict[str, dict[int, float]]:
    """Return the x of every round by stage; stage n, from 0, spans [n, n + 1]."""
    numbers = {stage: sorted({row.round or 0 for row in rounds if _stage_of(row) == stage}) for stage in STAGES}
    taken = {stage: known for stage, known in numbers.items() if known}
    return {
        stage: {number: start + (rank + 0.5) / len(known) for rank, number in enumerate(known)}
        for start, (stage, known) in enumerate(taken.items())
    }


def _stage_of(row: Row) -> str:
    return EDGE if row.round == 0 else row.stage


def _mark_stages(axes: Axes, places: Mapping[str, Mapping[int, float]]) -> None:
    """Write the stages' names above the axes, draw their borders, and number their first and last rounds."""
    for start, stage in enumerate(places):
        axes.text(start + 0.5, 1.02, STAGES[stage], transform=axes.get_xaxis_transform(), ha="center")
        if start:
            axes.axvline(start, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    ends = {known[number]: number for known in places.values() for number in (min(known), max(known))}
    axes.set_xticks(list(ends), [str(number) for number in ends.values()])
    lasts = {max(known.values()) for known in places.values() if len(known) > 1}
    for place, label in zip(ends, axes.get_xticklabels(), strict=True):
        label.set_horizontalalignment("right" if place in lasts else "left")  # keeps neighbouring numbers apart
    axes.set_xlim(0, len(places) + 0.12)


def _draw_interval(axes: Axes, x: float, reached: Estimate, colour: str) -> None:
    style.interval(axes, x, reached, color=colour, marker="_", markersize=7)
    axes.plot(x, reached.mean, "o", color=colour, markersize=6, markeredgecolor="white")


def draw_megabytes(axes: Axes, rows: Sequence[Row], budgets: Mapping[str, float]) -> None:
    """Draw a stacked bar of each link's uplink [MB], with a part per stage and a line at the link's budget [MB].

    `rows` are the rows of an arm from `tabulate`.
    """
    spent = {link: select(rows, quantity=f"arms.spent.{link}.mb") for link in budgets}
    stages = list(dict.fromkeys(row.stage for of_link in spent.values() for row in of_link))
    sums = {
        link: {stage: sum(row.value for row in select(of_link, stage=stage)) for stage in stages}
        for link, of_link in spent.items()
    }
    widest = max([*budgets.values(), *(mb for of_link in sums.values() for mb in of_link.values())])
    for y, (link, budget) in enumerate(budgets.items()):
        left = 0.0
        for sent, colour in zip(sums[link].values(), style.STAGE_COLOURS, strict=False):
            axes.barh(y, sent, left=left, height=0.42, color=colour, edgecolor="white")
            if sent > 0.05 * widest:
                axes.text(left + sent / 2, y, describe_megabytes(sent).split()[0], ha="center", va="center_baseline")
            left += sent
        axes.plot([budget, budget], [y - 0.34, y + 0.30], color=style.INK, linewidth=2)
        axes.text(budget, y - 0.37, f"{left:.0f} of {budget:.0f} MB", ha="right", va="bottom", fontsize=style.SMALL)
    patches = [
        Patch(color=colour, label=STAGES[stage]) for stage, colour in zip(stages, style.STAGE_COLOURS, strict=False)
    ]
    style.key(axes.figure, patches)
    axes.set_yticks(range(len(budgets)), list(budgets))
    axes.set(xlabel="uplink megabytes (1 MB = 10⁶ bytes)", ylim=(len(budgets) - 0.6, -0.65))


def draw_gains(axes: Axes, costs: Sequence[ArmCost], between: Mapping[str, tuple[float, Estimate]]) -> None:
    """Draw the measure of each arm of a task against its uplink [MB], with a line from pretraining.

    `between`: uplink and measure of arms after edge FL, where cloud FL follows.
    """
    palette = cycle((style.BLUE, *style.OTHER_COLOURS, style.VERMILLION))
    colours = dict(zip((cost.arm for cost in costs), palette, strict=False))
    most = max(cost.uplink_mb for cost in costs)
    at: dict[str, float] = {}  # by arm; intervals at the same megabytes are drawn side by side
    for cost in costs:
        colour = colours[cost.arm]
        near = [x for x in at.values() if abs(x - cost.uplink_mb) < most / 50]
        at[cost.arm] = x = cost.uplink_mb + len(near) * most / 60
        path = [(0.0, cost.before), (x, cost.after.mean)]
        if cost.arm in between:
            middle, reached = between[cost.arm]
            path.insert(1, (middle, reached.mean))
            _draw_interval(axes, middle, reached, colour)
        axes.plot(*zip(*path, strict=True), color=colour, linewidth=1.2, linestyle=(0, (3, 2)))
        axes.plot(0, cost.before, "o", color=colour, markerfacecolor="white", markersize=6, clip_on=False)
        _draw_interval(axes, x, cost.after, colour)
    low, top = axes.get_ylim()
    ends = {cost.arm: (at[cost.arm], cost.after.mean) for cost in costs}
    _name_ends(axes, ends, colours, LINE, lambda x: round(x / most, 1))
    axes.set(ylabel=costs[0].measure, xlim=(0, 1.08 * most), ylim=(low, top))
    axes.grid(axis="y")


def draw_by_megabytes(axes: Axes, lines: Mapping[str, Sequence[tuple[float, Estimate]]]) -> None:
    """Draw AP50 with intervals against uplink [MB], a line per name."""
    colours = (style.BLUE, *style.OTHER_COLOURS)
    for number, (name, points) in enumerate(lines.items()):
        colour = colours[number % len(colours)]
        axes.plot([x for x, _ in points], [ap.mean for _, ap in points], "o-", color=colour, label=name, markersize=4)
        for x, ap in points:
            style.interval(axes, x, ap, color=colour, linewidth=0.8)
    label = name_measure("AP50", (ap for points in lines.values() for _, ap in points))
    axes.set(xlabel="wireless uplink [MB]", ylabel=label, xlim=(0, None))
    axes.grid(axis="y")


def draw_by_cost(axes: Axes, lines: Mapping[str, Sequence[tuple[float, Estimate]]], cost: str) -> None:
    """Draw AP50 with its spread against a `cost` above 0 on a logarithmic axis, a line per name.

    Lines whose names are the same up to a comma have the same colour; those with one are solid and filled.
    """
    bases = list(dict.fromkeys(name.split(", ")[0] for name in lines))
    for number, (name, points) in enumerate(lines.items()):
        base, aside = name.split(", ")[0], 1.015 ** (number - len(lines) / 2)  # keeps intervals apart
        colour = (style.BLUE, style.VERMILLION, *style.OTHER_COLOURS)[bases.index(base) % 6]
        fill, dashes = (colour, "-") if name != base else ("white", (0, (2, 2)))
        xs = [x * aside for x, _ in points]
        axes.plot(
            xs, [ap.mean for _, ap in points],
            marker="o", color=colour, label=name, markersize=4.5, mfc=fill, linestyle=dashes,
        )  # fmt: skip
        for x, (_, ap) in zip(xs, points, strict=True):
            style.interval(axes, x, ap, color=colour, linewidth=0.8, alpha=0.6)
    axes.set(xscale="log", xlabel=cost)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y")


def draw_arms(axes: Axes, town: str, rows: Mapping[str, Estimate]) -> None:
    """Draw the forest plot of a town: mean and interval of each arm, with the numbers."""
    colour = _colour(town, [town])
    for y, ap in enumerate(rows.values()):
        text = f"{ap.mean:.3f}"
        if ap.low is not None and ap.high is not None:
            text += f"  ({ap.low:.3f}–{ap.high:.3f})"
            axes.plot([ap.low, ap.high], [y, y], color=colour, linewidth=2)
        axes.plot(ap.mean, y, "s", color=colour, markersize=6)
        axes.annotate(
            text,
            (1.0, y),
            (6, 0),
            xycoords=axes.get_yaxis_transform(),
            textcoords="offset points",
            va="center",
            fontsize=style.SMALL,
        )
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set(ylim=(len(rows) - 0.5, -0.5))
    axes.grid(axis="x")
