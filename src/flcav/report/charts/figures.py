"""Figures of a run's report: tables and arrays in, matplotlib figures out; `style.png` encodes one."""

import textwrap
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from flcav.report import style
from flcav.report.charts import runs
from flcav.report.pictures import clouds, maps, perspective
from flcav.report.pictures.changes import ErrorChanges, draw_changed, list_key
from flcav.runs.results.run import ArmCost
from flcav.runs.results.table import Row
from flcav.statistics.estimates import Estimate
from flcav.storage.records import select

WIDTH = 3.8  # of a figure on a phone [inch]
TALLEST = 2.0  # greatest height of a map, in widths; a higher map is drawn narrower
TITLE = 36  # characters of a line of a panel's title
ACROSS = 2  # entries of a map's legend per line


@style.styled
def town_map(scene: maps.ErrorMap, width_in: float = WIDTH) -> Figure:
    """Return the map of a town with candidate poles, registered errors, and the range of the chosen poles.

    It has a title, coordinates, a scale bar, and the names of the streets that have one.
    """
    x_low, y_low, x_high, y_high = scene.town.bounds
    bar = 0.9 if scene.heat else 0.0  # width of the colour bar [inch]
    margins = 0.9 + bar  # coordinates on both sides
    high = width_in * min((y_high - y_low) / (x_high - x_low), TALLEST)
    figure = style.canvas(width_in + margins, high + 1.7)
    axes = figure.add_subplot()
    maps.draw_errors(axes, scene)
    maps.draw_street_names(axes, scene)
    maps.draw_coordinates(axes, scene.town)
    axes.set_title(scene.title, fontweight="bold")
    style.key(figure, axes.get_legend_handles_labels()[0], ncols=ACROSS)
    return figure


@style.styled
def by_round(rounds: Sequence[Row], tested: Sequence[Row], measure: str) -> Figure:
    """Return a measure on validation frames after every round, and below it on test frames after every stage.

    Rows are as for `runs.draw_by_round` and `runs.draw_tested`.
    """
    figure = style.canvas(WIDTH, 1.35 * WIDTH)
    above, below = figure.subplots(2, height_ratios=(3, 2))
    runs.draw_by_round(above, rounds, measure)
    runs.draw_tested(below, tested, measure)
    return figure


@style.styled
def megabytes(rows: Sequence[Row], budgets: Mapping[str, float]) -> Figure:
    """Return the traffic of each stage on each link against the budgets by link [MB]."""
    figure = style.canvas(WIDTH, 0.55 * WIDTH)
    runs.draw_megabytes(figure.add_subplot(), rows, budgets)
    return figure


@style.styled
def gains(costs: Sequence[ArmCost], between: Mapping[tuple[str, str], tuple[float, Estimate]] | None = None) -> Figure:
    """Return the measures of arms against their uplink [MB], a panel per task; `between`: by arm and task."""
    tasks = dict.fromkeys(cost.task for cost in costs)
    figure = style.canvas(1.4 * WIDTH, 0.75 * WIDTH * len(tasks))
    for axes, task in zip(figure.subplots(len(tasks), squeeze=False)[:, 0], tasks, strict=True):
        of_task = {arm: point for (arm, at), point in (between or {}).items() if at == task}
        runs.draw_gains(axes, select(costs, task=task), of_task)
        axes.set_title(task, fontweight="bold")
    figure.axes[-1].set_xlabel("uplink of stages II and III [MB]")
    return figure


@style.styled
def arms(towns: Mapping[str, Mapping[str, Estimate]], measure: str = "AP50") -> Figure:
    """Return a forest plot of a measure by arm, with a panel per town."""
    figure = style.canvas(6.4, 0.9 + 0.32 * sum(map(len, towns.values())))
    heights = [len(rows) + 0.5 for rows in towns.values()]
    panels = figure.subplots(len(towns), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (town, rows) in zip(panels, towns.items(), strict=True):
        runs.draw_arms(axes, town, rows)
        axes.set_title(town, fontweight="bold")
    every = [estimate for rows in towns.values() for estimate in rows.values()]
    figure.supxlabel(runs.name_measure(measure, every), fontsize=style.TEXT)
    return figure


@style.styled
def arms_by_question(
    panels: Mapping[str, Mapping[str, Estimate]], marks: Mapping[str, float], measure: str = "AP50"
) -> Figure:
    """Return forest plots of a measure by arm: a panel per title, two abreast.

    `marks`: values by name that all panels have as vertical lines.
    """
    rows = [list(panels)[i : i + 2] for i in range(0, len(panels), 2)]
    heights = [max(len(panels[title]) for title in row) for row in rows]
    figure = style.canvas(13.2, sum(0.32 * height + 0.6 for height in heights) + 0.4)
    drawn = figure.subplots(len(rows), 2, sharex=True, squeeze=False, height_ratios=heights)
    for axes, (title, arms_) in zip(drawn.ravel(), panels.items(), strict=False):
        runs.draw_arms(axes, title, arms_)
        axes.set_title(title, fontweight="bold")
        axes.set_ylim(max(heights[list(panels).index(title) // 2], len(arms_)) - 0.5, -0.5)
        for (name, value), dash in zip(marks.items(), ((0, (1, 1.5)), (0, (4, 2))), strict=False):
            axes.axvline(value, color=style.MUTED, linewidth=1, linestyle=dash, label=name, zorder=0)
    every = [estimate for rows in panels.values() for estimate in rows.values()]
    for axes in drawn[-1]:
        axes.set_xlabel(runs.name_measure(measure, every))
    style.key(figure, [line for line in drawn[0, 0].get_lines() if line.get_label() in marks])
    return figure


@style.styled
def seeds(panels: Mapping[str, Mapping[str, Estimate]]) -> Figure:
    """Return differences with 95 % intervals, a row per seed: panels by title, side by side, with 0 as a line."""
    names = list(next(iter(panels.values())))
    figure = style.canvas(1.0 + 3.4 * len(panels), 1.4 + 0.3 * len(names))
    for axes, (title, rows) in zip(figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels.items()):
        axes.axvline(0, color=style.MUTED, linewidth=1)
        for y, change in enumerate(rows.values()):
            colour = style.GREEN if change.mean > 0 else style.VERMILLION
            if change.low is not None and change.high is not None:
                axes.plot([change.low, change.high], [y, y], color=colour, linewidth=2)
            axes.plot(change.mean, y, "s", color=colour, markersize=6)
        better = sum((change.low or 0.0) > 0 for change in rows.values())
        worse = sum((change.high or 0.0) < 0 for change in rows.values())
        lines = [line for part in title.splitlines() for line in textwrap.wrap(part, TITLE)]
        axes.set_title("\n".join(lines), fontweight="bold")
        told = [f"{word} 0 in {count}" for word, count in (("above", better), ("below", worse)) if count]
        counted = f"{', '.join(told)} of" if told else "0 in all of"
        axes.set_xlabel(f"{counted} {len(rows)} intervals (95 %)")
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.grid(axis="x")
    return figure


@style.styled
def by_megabytes(lines: Mapping[str, Sequence[tuple[float, Estimate]]]) -> Figure:
    """Return AP50 against uplink megabytes, with intervals: a line per name."""
    figure = style.canvas(1.6 * WIDTH, 1.1 * WIDTH)
    axes = figure.add_subplot()
    runs.draw_by_megabytes(axes, lines)
    style.key(figure, axes.get_legend_handles_labels()[0], ncols=2)
    return figure


@style.styled
def by_costs(costs: Mapping[str, Mapping[str, Sequence[tuple[float, Estimate]]]], start: float, label: str) -> Figure:
    """Return AP50, of `label`, against several costs, a panel each and a line per name; `start`: AP50 at no cost."""
    figure = style.canvas(2.2 * WIDTH, 1.1 * WIDTH)
    panels = figure.subplots(1, len(costs), sharey=True, squeeze=False)[0]
    for axes, (cost, lines) in zip(panels, costs.items(), strict=True):
        runs.draw_by_cost(axes, lines, cost)
        axes.axhline(start, color=style.MUTED, linewidth=0.8)
        axes.annotate(
            "pretrained",
            (1, start),
            (0, 3),
            xycoords=axes.get_yaxis_transform(),
            textcoords="offset points",
            ha="right",
        )
    panels[0].set_ylabel(label)
    style.key(figure, panels[0].get_legend_handles_labels()[0], ncols=3)
    return figure


@style.styled
def overview(changes: ErrorChanges, sweep: clouds.ComparedSweep, tested: Sequence[Row], measure: str) -> Figure:
    """Return the overview of a run: what became of the errors in a town, a sweep before and after, and the measure."""
    figure = style.canvas(12.8, 5.2)
    grid = figure.add_gridspec(1, 3, width_ratios=(4.4, 5.0, 3.0))
    left, middle, right = (figure.add_subfigure(grid[column]) for column in range(3))
    axes = left.add_subplot()
    draw_changed(axes, changes)
    axes.set_title(f"{changes.town.name}: errors before and after edge FL", fontweight="bold")
    style.key(left, list_key(changes), ncols=3)
    for axes, detections in zip(middle.subplots(2), (sweep.before, sweep.after), strict=True):
        perspective.draw_sweep(axes, sweep, detections)
    style.key(middle.axes[1], perspective.list_key(), loc="lower center", labelcolor=perspective.TEXT)
    axes = right.add_subplot()
    runs.draw_tested(axes, tested, measure, runs.LINE)
    axes.set_title(f"{measure} with 95 % intervals", fontweight="bold")
    return figure
