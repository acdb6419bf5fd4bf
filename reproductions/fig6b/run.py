"""Fig. 6b of Wang et al. (IEEE Network 37(3), 2023), predicted: the triangle of three tasks that share both budgets.

Its corners are the accuracies of objects, signs and weather, on axes 120 degrees apart. Plans are those of a run, from
the learning histories of the package and within the counts that these cover; nothing is trained. Intervals are of the
curves' residual bootstrap, with the same refitted curves for all plans. How exact the curves are is tested on numbers
of samples that they were not fitted to (Fig. 3a).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from flcav.arrays import Array
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.network.plan import MessageSizes
from flcav.optimization.allocation.allocate import TaskAllocation
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.curves.bands import bootstrap_bands
from flcav.optimization.curves.curves import OwnCurve
from flcav.optimization.curves.fitting import CurveFit, fit
from flcav.optimization.curves.history import History
from flcav.optimization.curves.levels import level_seeds
from flcav.optimization.problem import Budgets
from flcav.report import style
from flcav.reproductions.plan_search.run import FLEETS, JOINT, PROBLEMS, SIZES_MB, pose
from flcav.runs.allocation import allocate_tasks
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.tables import load_known_history
from flcav.statistics.estimates import TAILS, Estimate
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

TASKS = ("objects", "signs", "weather")
RULES = ("max-throughput", "equal-stages", JOINT)  # the first is the baseline
LOOKS = {  # of a rule's triangle
    rule: {"color": colour, "linewidth": width, "label": rule}
    for rule, colour, width in zip(RULES, (style.MUTED, style.ORANGE, style.BLUE), (4.5, 2.8, 1.2), strict=True)
}
BUDGETS_MB = (160.0, 320.0, 640.0)  # of either link

Plan = Mapping[str, tuple[int, int, int]]  # samples, edge and cloud rounds by task


@dataclass(frozen=True)
class Triangle:
    """A plan, and the accuracies and the area that the curves predict."""

    plan: Plan
    accuracy: Mapping[str, float]
    area: Estimate  # 1: all accuracies are 1


@dataclass(frozen=True)
class AtBudget:
    """The triangles under one pair of budgets."""

    budget_mb: float  # of either link
    triangles: Mapping[str, Triangle]  # by rule
    gains: Mapping[str, Estimate]  # area of the joint plan minus that of another rule


@dataclass(frozen=True)
class LeftOut:
    """Error of a task's curve at a number of samples that it was not fitted to."""

    task: str
    samples: int
    points: int
    error: float  # mean absolute difference of accuracy, of a mean seed
    inside: float  # error of the curve that is fitted to all


@dataclass(frozen=True)
class Triangles(Record):
    """Triangles by budget, and errors at sizes left out."""

    budgets: tuple[AtBudget, ...]
    left_out: tuple[LeftOut, ...]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the gains of the joint plan in words."""
        return [
            f"{at.budget_mb:g} MB of either link: area of the joint plan - {rule} {gain.describe(sign=True)}"
            for at in self.budgets
            for rule, gain in at.gains.items()
        ]


def measure_area(accuracies: Array) -> Array:
    """Return the areas (...) of triangles with corners at `accuracies` (..., 3) on axes 120 degrees apart.

    The unit is the area of the triangle with all corners at 1.
    """
    one, two, three = np.moveaxis(np.asarray(accuracies, dtype=np.float64), -1, 0)
    return np.asarray((one * two + two * three + three * one) / 3)


def compare_plans(plans: Mapping[str, Plan], refitted: Mapping[str, Sequence[OwnCurve]], budget_mb: float) -> AtBudget:
    """Return the triangles of plans by rule, with percentile intervals over refitted curves.

    `refitted`: by task the curve itself, and those of the bootstrap.
    """

    draws = min(map(len, refitted.values()))
    predicted = {
        rule: np.array([[1 - float(refitted[task][i].error(*plan[task], 1)) for task in TASKS] for i in range(draws)])
        for rule, plan in plans.items()
    }
    areas = {rule: measure_area(values) for rule, values in predicted.items()}

    def within(values: Array) -> Estimate:
        low, high = np.quantile(values[1:], TAILS).tolist()
        return Estimate(float(values[0]), low, high)

    return AtBudget(
        budget_mb,
        {
            rule: Triangle(plan, dict(zip(TASKS, predicted[rule][0].tolist(), strict=True)), within(areas[rule]))
            for rule, plan in plans.items()
        },
        {rule: within(areas[JOINT] - areas[rule]) for rule in plans if rule != JOINT},
    )


def refit_curves(found: CurveFit) -> tuple[OwnCurve, ...]:
    """Return a fitted curve, and those that are fitted anew in the bootstrap's repeats."""
    bands = bootstrap_bands(found)
    return (found.curve, *(() if bands is None else bands.curves))


def make_plans(budget_mb: float) -> dict[str, Plan]:
    """Return the plans of all rules under a budget [MB] of either link."""
    problem = next(each for each in PROBLEMS if set(each.tasks) == set(TASKS))
    sizes = {task: MessageSizes(*SIZES_MB[history], None) for task, history in problem.tasks.items()}
    posed = pose(problem, sizes, FLEETS[0], [1.0] * len(TASKS)).model_copy(
        update={"budgets_mb": Budgets(wireless=budget_mb, wireline=budget_mb)}
    )

    def counts(tasks: Sequence[TaskAllocation]) -> Plan:
        return {task.name: (task.samples, task.edge_rounds, task.cloud_rounds) for task in tasks}

    return {rule: counts(allocate_tasks(posed)[0] if rule == JOINT else baseline(posed, rule).tasks) for rule in RULES}


def leave_sizes_out(task: str, history: History, curve_of: Callable[[History], CurveFit]) -> list[LeftOut]:
    """Return the errors at each number of samples, of the curve fitted to the others; points are of a mean seed."""
    levelled = replace(level_seeds(history).history, seeds=())
    samples = levelled.resources[:, 0]
    whole = curve_of(levelled)

    def error(found: CurveFit, at: np.ndarray) -> float:
        own = levelled.select(at)
        predicted = 1 - found.curve.error(*own.resources.T, k=1)
        return float(np.abs(predicted - own.accuracy).mean())

    return [
        LeftOut(task, int(size), int(at.sum()), error(curve_of(levelled.select(~at)), at), error(whole, at))
        for size in np.unique(samples)
        for at in [samples == size]
    ]


def tabulate_triangles(results: Triangles) -> dict[str, str]:
    """Return Markdown by name: triangles, gains, sizes."""
    return {
        "triangles": format_table(
            ("MB of either link", "rule", *(f"{task}: samples / edge / cloud" for task in TASKS), *TASKS, "area"),
            [
                [
                    f"{at.budget_mb:g}",
                    rule,
                    *("/".join(map(str, of.plan[task])) for task in TASKS),
                    *(f"{of.accuracy[task]:.3f}" for task in TASKS),
                    of.area.describe(),
                ]
                for at in results.budgets
                for rule, of in ((rule, at.triangles[rule]) for rule in RULES)
            ],
        ),
        "gains": format_table(
            ("MB of either link", *(f"area, joint - {rule}" for rule in RULES if rule != JOINT)),
            [
                [f"{at.budget_mb:g}", *(at.gains[rule].describe(sign=True) for rule in RULES if rule != JOINT)]
                for at in results.budgets
            ],
        ),
        "sizes": format_table(
            ("history", "samples left out", "points", "mean error there", "of the curve fitted to all"),
            [
                [each.task, each.samples, each.points, f"{each.error:.3f}", f"{each.inside:.3f}"]
                for each in results.left_out
            ],
        ),
    }


def draw_axes(axes: Axes, title: str) -> None:
    """Draw the tasks' axes, with a line for each quarter of accuracy."""
    style.hide_axes(axes)
    for share in (0.25, 0.5, 0.75, 1.0):
        draw_triangle(axes, dict.fromkeys(TASKS, share), color=style.SIDEWALK, linewidth=1, zorder=0)
    for task, corner in zip(TASKS, place_corners(), strict=True):
        axes.plot(*np.vstack(([0, 0], corner)).T, color=style.SIDEWALK, linewidth=1, zorder=0)
        across, up = (1.14 * corner).tolist()
        axes.text(across, up, task, ha="center", va="center")
    axes.set_title(title, fontweight="bold")
    axes.set(aspect="equal", xlim=(-1.25, 1.25), ylim=(-0.85, 1.3))


def draw_triangle(axes: Axes, accuracy: Mapping[str, float], **look: Any) -> None:
    """Draw the triangle of the tasks' accuracies; `look`: options of `plot`."""
    ends = place_corners() * np.array([accuracy[task] for task in TASKS])[:, None]
    across, up = np.vstack((ends, ends[:1])).T
    axes.plot(across, up, **look)


def place_corners() -> Array:
    """Return the unit vectors (3, 2) of the tasks' axes."""
    angles = np.pi / 2 + 2 * np.pi / 3 * np.arange(len(TASKS))
    return np.column_stack((np.cos(angles), np.sin(angles)))


@style.styled
def draw_triangles(results: Triangles) -> bytes:
    """Return the triangles as a PNG, a panel for each budget."""
    figure = style.canvas(3.6 * len(results.budgets), 3.7)
    panels = figure.subplots(1, len(results.budgets), squeeze=False)[0]
    for axes, at in zip(panels, results.budgets, strict=True):
        draw_axes(axes, f"{at.budget_mb:g} MB of either link")
        for rule, look in LOOKS.items():
            draw_triangle(axes, at.triangles[rule].accuracy, **look)
    style.key(figure, panels[0].get_legend_handles_labels()[0])
    return style.png(figure)


def _run(_: Path, options: Options) -> Outcome[Triangles]:
    histories = {task: load_known_history(task) for task in TASKS}
    curves = {task: refit_curves(fit(history, model="best")) for task, history in histories.items()}
    budgets = list[AtBudget]()
    with options.show_progress(options.title) as report:
        for budget in BUDGETS_MB:
            budgets.append(compare_plans(make_plans(budget), curves, budget))
            report(len(budgets), len(BUDGETS_MB), f"{budget:g} MB")
    left_out = [each for task, history in histories.items() for each in leave_sizes_out(task, history, fit)]
    results = Triangles(tuple(budgets), tuple(left_out), provenance())
    return Outcome(results, {"triangles.png": draw_triangles(results)}, results.sentences())


EXPERIMENT = Experiment(Triangles, _run, tabulate_triangles, seeds=1, takes=())
