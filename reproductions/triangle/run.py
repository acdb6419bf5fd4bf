"""Fig. 6b of Wang et al. (IEEE Network 37(3), 2023), trained: the triangles of three plans under one pair of budgets.

The recipe is recipes/runs/triangle.yaml. Corners are what the networks of a plan reach after stage III, in the mean of
the federating towns, beside what the run's curves predict for the plan. Intervals are over test scenes: of an area, and
of a difference of areas of networks on the same frames, by the delta method. Of the run only the steps that these tests
need are made.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.reproductions.fig6b.run import LOOKS, RULES, TASKS, draw_axes, draw_triangle, measure_area
from flcav.reproductions.plan_search.run import JOINT
from flcav.reproductions.triangle.strips import STOP_TOWN, Counted, film_crossings, film_stops
from flcav.runs.analysis.differences import compare_tests, test_folder
from flcav.runs.edge_stage import list_needed
from flcav.runs.engine import run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, MAIN
from flcav.runs.results.plans import Plan
from flcav.runs.results.tests import Tested
from flcav.runs.running import WORK
from flcav.runs.stages.graph import Graph
from flcav.statistics.estimates import Estimate, average_estimates
from flcav.storage.markdown import format_signed, format_table
from flcav.storage.records import Record

ARMS = {"max-throughput": "most", "equal-stages": "equal", JOINT: MAIN}  # by rule


@dataclass(frozen=True)
class Trained:
    """A plan, what the curves predict for it and what its networks reach."""

    plan: Mapping[str, tuple[int, int, int]]  # samples, edge and cloud rounds by task
    predicted: Mapping[str, float]  # accuracy by task
    predicted_area: float  # 1: all accuracies are 1
    accuracy: Mapping[str, Estimate]  # by task
    area: Estimate


@dataclass(frozen=True)
class Gain:
    """The joint plan minus another one."""

    predicted: float  # of the area
    accuracy: Mapping[str, Estimate]  # by task, on the same frames
    area: Estimate


@dataclass(frozen=True)
class TrainedTriangles(Record):
    """Triangles and gains by rule, and what is found in the frames of the strips."""

    triangles: Mapping[str, Trained]
    gains: Mapping[str, Gain]
    strips: Mapping[str, Mapping[str, Counted]]  # by strip and rule
    recipe: Mapping[str, Json]  # without its seed
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return areas and gains in words."""
        areas = [
            f"{rule}: area predicted {own.predicted_area:.3f}, trained {own.area.describe()}"
            for rule, own in self.triangles.items()
        ]
        return areas + [
            f"area of the joint plan - {rule}: predicted {own.predicted:+.3f}, trained {own.area.describe(sign=True)}"
            for rule, own in self.gains.items()
        ]


def find_slopes(accuracies: Array) -> Array:
    """Return the derivatives (3,) of `measure_area` by the accuracies (3,) of its corners."""
    return (accuracies.sum() - accuracies) / 3


def estimate_area(accuracy: Mapping[str, Estimate]) -> Estimate:
    """Return the area of the triangle; tasks are tested on scenes of their own."""
    means = np.array([accuracy[task].mean for task in TASKS])
    return carry_intervals(float(measure_area(means)), find_slopes(means), accuracy)


def estimate_gain(one: Mapping[str, Estimate], other: Mapping[str, Estimate], gain: Mapping[str, Estimate]) -> Estimate:
    """Return the area of `one` minus that of `other`, from the paired differences `gain` of their accuracies.

    An area is of second degree in its corners, so that the slopes half way between both give the exact difference.
    """
    middle = np.array([(one[task].mean + other[task].mean) / 2 for task in TASKS])
    slopes = find_slopes(middle)
    return carry_intervals(float(slopes @ [gain[task].mean for task in TASKS]), slopes, gain)


def carry_intervals(mean: float, slopes: Array, parts: Mapping[str, Estimate]) -> Estimate:
    """Return an estimate from independent parts by task: half-widths, times slopes (3,) >= 0, add in quadrature."""
    estimates = [parts[task] for task in TASKS]
    below = [each.mean - each.low for each in estimates if each.low is not None]
    above = [each.high - each.mean for each in estimates if each.high is not None]
    if min(len(below), len(above)) < len(TASKS):
        return Estimate(mean, None, None)
    return Estimate(mean, mean - float(np.linalg.norm(slopes * below)), mean + float(np.linalg.norm(slopes * above)))


def find_test(graph: Graph, work: Path, rule: str, town: str, task: str) -> Path:
    """Return the folder of the test of a rule's network after stage III in a town."""
    return work / test_folder(graph, ARMS[rule], CLOUD, town, task)


def measure_plan(graph: Graph, work: Path, rule: str) -> Trained:
    """Return the plan of a rule, its predictions, and what its networks reach in the mean of the federating towns."""
    plans = Plan.load(work / graph.names.plan(ARMS[rule])).tasks
    predicted = {task: (plans[task].predicted or {})[CLOUD] for task in TASKS}
    towns = graph.recipe.with_role("federate")
    accuracy = {
        task: average_estimates([Tested.load(find_test(graph, work, rule, town, task)).estimate for town in towns])
        for task in TASKS
    }
    return Trained(
        {task: (plans[task].samples, plans[task].edge_rounds, plans[task].cloud_rounds) for task in TASKS},
        predicted,
        float(measure_area(np.array([predicted[task] for task in TASKS]))),
        accuracy,
        estimate_area(accuracy),
    )


def subtract_accuracy(graph: Graph, work: Path, rule: str, task: str) -> Estimate:
    """Return a task's accuracy by the joint plan minus that by another rule, on the same frames of both towns.

    It is 0 where both rules share their training.
    """
    pairs = [
        [find_test(graph, work, each, town, task) for each in (rule, JOINT)]
        for town in graph.recipe.with_role("federate")
    ]
    return average_estimates(
        [
            Estimate(0.0, 0.0, 0.0) if before == after else compare_tests(task, before, after, graph.recipe.seed)
            for before, after in pairs
        ]
    )


def compare_triangles(graph: Graph, work: Path, strips: Mapping[str, Mapping[str, Counted]]) -> TrainedTriangles:
    """Return the triangles of the plans that a run trained in `work`, and the gains of the joint one."""
    triangles = {rule: measure_plan(graph, work, rule) for rule in RULES}
    joint, gains = triangles[JOINT], dict[str, Gain]()
    for rule in (rule for rule in RULES if rule != JOINT):
        other = triangles[rule]
        accuracy = {task: subtract_accuracy(graph, work, rule, task) for task in TASKS}
        area = estimate_gain(joint.accuracy, other.accuracy, accuracy)
        gains[rule] = Gain(joint.predicted_area - other.predicted_area, accuracy, area)
    settings = graph.recipe.model_dump(mode="json", exclude={"seed"})
    return TrainedTriangles(triangles, gains, strips, settings, provenance(graph.recipe.seed))


def tabulate_triangles(results: TrainedTriangles) -> dict[str, str]:
    """Return Markdown by name: triangles, gains, strips."""
    return {
        "triangles": format_table(
            ("rule", "task", "samples / edge / cloud", "accuracy, predicted", "trained"),
            [
                row
                for rule in RULES
                for own in [results.triangles[rule]]
                for row in (
                    *(
                        [
                            rule,
                            task,
                            "/".join(map(str, own.plan[task])),
                            f"{own.predicted[task]:.3f}",
                            own.accuracy[task].describe(),
                        ]
                        for task in TASKS
                    ),
                    [rule, "**area**", "", f"{own.predicted_area:.3f}", own.area.describe()],
                )
            ],
        ),
        "gains": format_table(
            ("joint plan minus", "area, predicted", "area, trained", *TASKS),
            [
                [
                    rule,
                    format_signed(own.predicted),
                    own.area.describe(sign=True),
                    *(own.accuracy[task].describe(sign=True) for task in TASKS),
                ]
                for rule, own in ((rule, results.gains[rule]) for rule in RULES if rule != JOINT)
            ],
        ),
        "strips": format_table(
            ("strip", "rule", "found", "of", "false"),
            [
                [strip, rule, own.found, own.targets, own.false]
                for strip, by_rule in results.strips.items()
                for rule, own in ((rule, by_rule[rule]) for rule in RULES)
            ],
        ),
    }


@style.styled
def draw_both(results: TrainedTriangles) -> bytes:
    """Return predicted and trained triangles side by side as a PNG."""
    figure = style.canvas(7.4, 3.8)
    predicted, trained = figure.subplots(1, 2)
    draw_axes(predicted, "predicted")
    draw_axes(trained, "trained")
    for rule, own in results.triangles.items():
        draw_triangle(predicted, own.predicted, **LOOKS[rule])
        draw_triangle(trained, {task: own.accuracy[task].mean for task in TASKS}, **LOOKS[rule])
    style.key(figure, predicted.get_legend_handles_labels()[0])
    return style.png(figure)


def _run(out: Path, options: Options) -> Outcome[TrainedTriangles]:
    graph = Graph(options.load("triangle", shrink_recipe), Path())
    work = out / WORK
    wanted = {
        graph.names.recording(STOP_TOWN, "test", "signs"),  # the other strip has frames of a federating town
        *(find_test(graph, work, *at).name for at in product(RULES, graph.recipe.with_role("federate"), TASKS)),
    }
    asked = [step for step in graph.steps if step.name in wanted]
    with options.show_steps(options.title) as notify:
        run_steps([*list_needed(graph.steps, asked), *asked], work, **options.how(notify))
    stops, crossings = (film(graph.names, work, ARMS) for film in (film_stops, film_crossings))
    results = compare_triangles(graph, work, {"stop signs": stops.counted, "cross-roads": crossings.counted})
    pictures = {
        "triangles.png": draw_both(results),
        "stops.png": stops.picture,
        "crossings.png": crossings.picture,
    }
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(
    TrainedTriangles,
    _run,
    tabulate_triangles,
    seeds=1,
    takes=("scale", "jobs", "engine", "stale"),
    recipe="triangle",
)
