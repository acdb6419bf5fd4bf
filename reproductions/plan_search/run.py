"""Search for budgets, fleets, messages and importances under which the joint plan is predicted to beat equal shares.

Plans are those of a run (`flcav.runs.allocation`), from the learning histories of the package and within the counts
that these cover, so that no curve is extrapolated. Nothing is trained: a setting with a predicted difference of `WORTH`
or more is one in which a training can tell the plans apart.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from flcav.config import read_json
from flcav.experiments import FOLDER
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.network.ledger import LinkMegabytes
from flcav.network.plan import MessageSizes
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.curves.history import History
from flcav.optimization.problem import Budgets
from flcav.optimization.problem import Problem as AllocationProblem
from flcav.optimization.solvers.instance import Infeasible
from flcav.report import style
from flcav.reproductions.plan_ranking.run import PlanRanking, collect_history
from flcav.runs.allocation import PlanRequest, PlanSettings, allocate_tasks, make_plan, make_task_plan
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, PlanLimits
from flcav.runs.tables import parse_history, read_history
from flcav.storage.markdown import format_signed, format_table
from flcav.storage.records import Record

WORTH = 0.03  # predicted difference that is worth a training
ACROSS, MOST_TICKS = 4, 6  # heat tables side by side; labels of an axis that has room for them
JOINT, RIVALS = "joint", ("equal-stages", "equal-tasks")
WIRELESS_MB = tuple(np.geomspace(20, 640, 11).tolist())
WIRELINE_MB = tuple(np.geomspace(10, 320, 6).tolist())
FLEETS = ((4, 3), (2, 2), (8, 6))  # vehicles by region
SIZES_MB = {  # of a sample and of an update, by history: those of the networks that it is of
    "objects": (0.447, 1.35),
    "tracks": (0.447, 0.664),
    "signs": (0.35, 3.6),
    "weather": (0.077, 0.25),
}
FORMS = {"whole": 1.0, "8 bits": 0.27}  # of updates: share of their bytes
TOWNS = {"both towns": ("grid", "ring"), "all like grid": ("grid",), "all like ring": ("ring",)}
IMPORTANCES = ((1.0, 1.0, 1.0), (4.0, 1.0, 1.0), (1.0, 4.0, 1.0))  # of objects, signs, weather


@dataclass(frozen=True)
class Problem:
    """A family of settings: its tasks, their histories, and the plan that the joint one is compared with."""

    name: str
    tasks: Mapping[str, str]  # task -> name of its history
    rival: str
    towns: tuple[str, ...] = ()  # whose curve: of plans that were trained apart there; none: that of the history


PROBLEMS = (
    Problem("objects, labels by the road", {"objects": "objects"}, RIVALS[0]),
    Problem("objects, labels by road and tracks", {"objects": "tracks"}, RIVALS[0]),
    *(
        Problem(f"objects, plans trained apart, {where}", {"objects": "tracks"}, RIVALS[0], towns)
        for where, towns in TOWNS.items()
    ),
    Problem("three tasks, equal stages", {name: name for name in ("objects", "signs", "weather")}, RIVALS[0]),
    Problem("three tasks, equal tasks", {name: name for name in ("objects", "signs", "weather")}, RIVALS[1]),
)


@dataclass(frozen=True)
class Found:
    """Both plans of a setting and the mean accuracy that the curves predict, weighted by importance."""

    problem: str
    wireless_mb: float
    wireline_mb: float
    fleet: tuple[int, ...]
    form: str  # of updates
    importance: tuple[float, ...]
    joint: tuple[tuple[int, int, int], ...]  # samples, edge and cloud rounds by task
    rival: tuple[tuple[int, int, int], ...]
    predicted: tuple[float, float]  # joint, rival

    @property
    def difference(self) -> float:
        """The predicted gain of the joint plan."""
        return self.predicted[0] - self.predicted[1]


@dataclass(frozen=True)
class SearchResult(Record):
    """Results of the search: the number of settings of each problem, and those with the largest differences."""

    settings: Mapping[str, int]
    worth: Mapping[str, int]  # settings whose difference is at least `WORTH`
    more: Mapping[str, tuple[int, ...]]  # settings in which the joint plan has more edge, and more cloud, rounds
    best: tuple[Found, ...]  # by problem, the largest first
    maps: Mapping[str, tuple[tuple[float, float, float], ...]]  # wireless, wireline [MB], difference: the first fleet's
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the counts in words."""
        return [f"{name}: {self.worth[name]} of {count} settings" for name, count in self.settings.items()]


def search_plans(problem: Problem) -> Iterator[Found]:
    """Yield the plans of all settings of a problem that both rules can afford."""
    several = len(problem.tasks) > 1
    fleets, weights = (FLEETS[:1], IMPORTANCES) if several else (FLEETS, ((1.0,),))
    for fleet, form, importance in product(fleets, FORMS, weights):
        mb = {task: SIZES_MB[history] for task, history in problem.tasks.items()}
        sizes = {task: MessageSizes(sample, FORMS[form] * update, None) for task, (sample, update) in mb.items()}
        base = pose(problem, sizes, fleet, importance)
        for wireless, wireline in product(WIRELESS_MB[::2] if several else WIRELESS_MB, WIRELINE_MB):
            posed = base.model_copy(update={"budgets_mb": Budgets(wireless=wireless, wireline=wireline)})
            try:
                allotted = allocate_tasks(posed)[0], baseline(posed, problem.rival).tasks
            except Infeasible:
                continue
            plans = [[make_task_plan(sizes[task.name], task, posed, {}) for task in tasks] for tasks in allotted]
            counts = [tuple((task.samples, task.edge_rounds, task.cloud_rounds) for task in plan) for plan in plans]
            reached = [
                float(np.average([(task.predicted or {})[CLOUD] for task in plan], weights=importance))
                for plan in plans
            ]
            yield Found(
                problem.name,
                wireless,
                wireline,
                fleet,
                form,
                importance,
                counts[0],
                counts[1],
                (reached[0], reached[1]),
            )


def read_histories(problem: Problem) -> dict[str, History]:
    """Return the histories of a problem's tasks: those of the package, or what a town's plans reached."""
    if not problem.towns:
        return {
            task: parse_history(task, read_history(task, name, Path()), name) for task, name in problem.tasks.items()
        }
    ranking = PlanRanking.from_json(read_json(FOLDER / "plan_ranking" / "result.json"), "plan_ranking")
    return dict.fromkeys(problem.tasks, collect_history(ranking.seeds, problem.towns))


def pose(
    problem: Problem, sizes: Mapping[str, MessageSizes], fleet: tuple[int, ...], importance: Sequence[float]
) -> AllocationProblem:
    """Return the allocation problem of a fleet, with budgets to be set; counts end where the histories do."""
    histories = read_histories(problem)
    requests = tuple(
        PlanRequest(task, weight, sizes[task], int(history.resources[:, 0].max()), history, None)
        for (task, history), weight in zip(histories.items(), importance, strict=True)
    )
    least = max(int(history.resources[:, 0].min()) for history in histories.values())
    ample = LinkMegabytes(1e6, 1e6)
    posed = make_plan(requests, PlanSettings(ample, 0.0, PlanLimits(samples=(least, None)), fleet, 1), JOINT)[1]
    assert posed is not None  # no plan is fixed
    return posed


def summarise(found: Mapping[str, Sequence[Found]], most: int = 3) -> SearchResult:
    """Return the results of the settings of each problem."""
    best = {name: sorted(rows, key=lambda row: -row.difference)[:most] for name, rows in found.items()}
    return SearchResult(
        settings={name: len(rows) for name, rows in found.items()},
        worth={name: sum(row.difference >= WORTH for row in rows) for name, rows in found.items()},
        more={
            name: tuple(
                sum(sum(task[stage] for task in row.joint) > sum(task[stage] for task in row.rival) for row in rows)
                for stage in (1, 2)
            )
            for name, rows in found.items()
        },
        best=tuple(row for rows in best.values() for row in rows),
        maps={
            name: tuple(
                (row.wireless_mb, row.wireline_mb, row.difference)
                for row in rows
                if (row.fleet, row.form, row.importance) == (FLEETS[0], "whole", rows[0].importance)
            )
            for name, rows in found.items()
        },
        provenance=provenance(),
    )


@style.styled
def draw_search(results: SearchResult) -> bytes:
    """Return the predicted difference by budgets as a PNG, a heat table for each problem."""
    lines = -(-len(results.maps) // ACROSS)
    figure = style.canvas(3.0 * ACROSS + 1.2, 3.4 * lines)
    panels = figure.subplots(lines, ACROSS, squeeze=False)
    top = max(WORTH, *(row[2] for rows in results.maps.values() for row in rows))
    for axes in panels.ravel()[len(results.maps) :]:
        axes.set_axis_off()
    for axes, (name, rows) in zip(panels.ravel(), results.maps.items(), strict=False):
        budgets = [sorted({row[link] for row in rows}) for link in (0, 1)]
        table = np.full([len(of) for of in reversed(budgets)], np.nan)
        for wireless, wireline, difference in rows:
            at = budgets[1].index(wireline), budgets[0].index(wireless)
            table[at] = difference
            if difference >= WORTH:
                axes.plot(at[1], at[0], "o", color="white", markersize=4)
        axes.imshow(table, origin="lower", vmin=0, vmax=top, cmap="viridis", aspect="auto")
        for axis, of in zip((axes.xaxis, axes.yaxis), budgets, strict=True):
            every = 2 if len(of) > MOST_TICKS else 1
            ticks = range(0, len(of), every)
            axis.set_ticks(ticks, [f"{of[tick]:.0f}" for tick in ticks], fontsize=style.SMALL)
        axes.set_xlabel("wireless budget [MB]")
        axes.set_title(name.replace(", ", ",\n"))
    for axes in panels[:, 0]:
        axes.set_ylabel("wireline budget [MB]")
    figure.colorbar(
        panels[0, 0].images[0], ax=panels, label=f"predicted gain of the joint plan\n(dots: {WORTH} or more)"
    )
    return style.png(figure)


def tabulate_search(results: SearchResult) -> dict[str, str]:
    """Return Markdown by name: counts, best."""
    heads = ("tasks", "settings", f"predicted difference of {WORTH} or more", "more edge rounds", "more cloud rounds")
    about = (
        "tasks",
        "wireless, wireline MB",
        "vehicles",
        "updates",
        "importance",
        "joint",
        "equal",
        "predicted",
        "gain",
    )
    return {
        "counts": format_table(
            heads, [[name, count, results.worth[name], *results.more[name]] for name, count in results.settings.items()]
        ),
        "best": format_table(
            about,
            [
                [
                    row.problem,
                    f"{row.wireless_mb:.0f}, {row.wireline_mb:.0f}",
                    " + ".join(map(str, row.fleet)),
                    row.form,
                    " : ".join(f"{value:g}" for value in row.importance),
                    *("; ".join("/".join(map(str, task)) for task in plan) for plan in (row.joint, row.rival)),
                    f"{row.predicted[0]:.3f}, {row.predicted[1]:.3f}",
                    format_signed(row.difference),
                ]
                for row in results.best
            ],
        ),
    }


def _run(out: Path, options: Options) -> Outcome[SearchResult]:
    found = {}
    with options.show_progress(options.title) as report:
        for done, problem in enumerate(PROBLEMS, start=1):
            found[problem.name] = [*search_plans(problem)]
            report(done, len(PROBLEMS), problem.name)
    results = summarise(found)
    return Outcome(results, {"search.png": draw_search(results)}, results.sentences())


EXPERIMENT = Experiment(SearchResult, _run, tabulate_search, seeds=1, takes=())
