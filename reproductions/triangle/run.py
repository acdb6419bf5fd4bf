"""Fig. 6b of Wang et al. (IEEE Network 37(3), 2023), trained once and small: three plans of three tasks.

The recipe is recipes/runs/triangle.yaml. The triangle of a plan has the accuracies of its networks after stage III on
test frames of both federating regions, beside those that the curves of `reproductions/fig6b` predict for the same
counts. The same frames through the networks of the plans, as in the article's examples: stop signs under clouds, and
what is found at cross-roads, from above.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome, list_works, shrink_recipe
from flcav.geometry import Boxes
from flcav.geometry.poses import inverse
from flcav.optimization.curves.fitting import fit
from flcav.perception.marks import CloudBoxes, PictureBoxes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import Finding, Task
from flcav.perception.weights import load_network
from flcav.report import style
from flcav.report.pictures.clouds import draw_boxes, on_page
from flcav.report.pictures.inference import boxes_in_picture
from flcav.reproductions.fig6b.run import (
    COLOURS,
    RULES,
    TASKS,
    AtBudget,
    Plan,
    compare_plans,
    draw_axes,
    draw_triangle,
    measure_area,
    refit_curves,
)
from flcav.reproductions.plan_search.run import JOINT
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, MAIN
from flcav.runs.results.run import Run
from flcav.runs.results.saved import WEIGHTS
from flcav.runs.tables import load_known_history
from flcav.statistics.estimates import Estimate
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.weather import classify_weather

ARMS = {"max-throughput": "most", "equal-stages": "equal", JOINT: MAIN}  # by rule
STOP, STOP_TOWN, CROSS_TOWN = "stop", "suburb", "grid"
CLOUDY = ("cloudy", "overcast")
SHOWN = 4  # frames of a strip
REACH_M = 40.0  # [m] shown around a vehicle
SIGNS_FROM, OBJECTS_FROM = 0.25, 0.3  # scores from which marks are drawn


@dataclass(frozen=True)
class Realised:
    """What the networks of a plan reach after stage III, in the mean over both regions."""

    plan: Plan
    accuracy: Mapping[str, Estimate]  # by task, intervals over test scenes
    area: Estimate


@dataclass(frozen=True)
class TrainedTriangles(Record):
    """Predicted and realised triangles by rule."""

    predicted: AtBudget
    realised: Mapping[str, Realised]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return predicted and realised areas in words."""
        return [
            f"{rule}: area predicted {self.predicted.triangles[rule].area.describe()}, realised {own.area.describe()}"
            for rule, own in self.realised.items()
        ]


def average(estimates: Sequence[Estimate], weights: Sequence[float]) -> Estimate:
    """Return the weighted sum of independent estimates; the halves of intervals add in squares (delta method)."""
    mean = float(np.dot(weights, [each.mean for each in estimates]))
    below, above = (
        float(np.linalg.norm([weight * (end - each.mean) for weight, each, end in zip(weights, estimates, ends)]))
        for ends in zip(*((each.low, each.high) for each in estimates), strict=True)
        if None not in ends
    )
    return Estimate(mean, mean - below, mean + above)


def find_area(accuracy: Mapping[str, Estimate]) -> Estimate:
    """Return the area of the triangle, with an interval by the delta method; tasks are tested on other scenes."""
    values = np.array([accuracy[task].mean for task in TASKS])
    slopes = (values.sum() - values) / 3
    spread = average([accuracy[task] for task in TASKS], slopes.tolist())
    area = float(measure_area(values))
    assert spread.low is not None
    assert spread.high is not None
    return Estimate(area, area - (spread.mean - spread.low), area + (spread.high - spread.mean))


def measure_rule(run: Run, rule: str) -> Realised:
    """Return the counts of a rule's plan and what its networks reach."""
    arm, home = ARMS[rule], run.recipe.with_role("federate")
    tasks = run.arms[arm].plan.tasks
    plan = {task: (tasks[task].samples, tasks[task].edge_rounds, tasks[task].cloud_rounds) for task in TASKS}
    accuracy = {
        task: average(
            [run.test(arm=arm, stage=CLOUD, region=region, task=task).estimate for region in home],
            [1 / len(home)] * len(home),
        )
        for task in TASKS
    }
    return Realised(plan, accuracy, find_area(accuracy))


def compare_triangles(run: Run) -> TrainedTriangles:
    """Return the triangles that a run realised, beside those that the curves predict for the same counts."""
    realised = {rule: measure_rule(run, rule) for rule in RULES}
    curves = {task: refit_curves(fit(load_known_history(task), model="best")) for task in TASKS}
    plans = {rule: own.plan for rule, own in realised.items()}
    return TrainedTriangles(compare_plans(plans, curves, run.recipe.budgets_mb.wireless), realised, provenance())


def choose_stops(data: Dataset, vehicles: Sequence[int]) -> list[int]:
    """Return the frames under clouds with the largest stop signs, one a scene where there are enough."""
    config = next(iter(SIGNS.configurations.values()))
    stop = config.classes.index(STOP)
    sizes: dict[int, float] = {}
    for number in vehicles:
        weather = data.frame(number).weather
        if weather is None or classify_weather(weather) not in CLOUDY:
            continue
        sample = SIGNS.samples(data, config, [number])[0]
        boxes = sample.boxes[sample.label == stop]
        if len(boxes):
            sizes[number] = float((boxes[:, 2:] - boxes[:, :2]).prod(axis=1).max())
    return take_apart(data, sizes)


def choose_crossings(data: Dataset, vehicles: Sequence[int]) -> list[int]:
    """Return the frames with most road users in reach, one a scene where there are enough."""
    counts = {number: float(len(near_boxes(data, number))) for number in vehicles}
    return take_apart(data, counts)


def near_boxes(data: Dataset, number: int) -> Boxes:
    """Return the annotated boxes of road users within `REACH_M` of the LiDAR ahead and aside, in its frame."""
    frame = data.frame(number)
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor(next(iter(frame.lidar)))))
    return boxes[np.abs(boxes.center[:, :2]).max(axis=1) < REACH_M]


def take_apart(data: Dataset, values: Mapping[int, float]) -> list[int]:
    """Return the `SHOWN` frames of the largest values, the best of each scene before further ones, in their order."""
    ranked = sorted(values, key=lambda number: -values[number])
    best = {data.keys[number].scene: number for number in reversed(ranked)}
    first = sorted(best.values(), key=lambda number: -values[number])
    return sorted([*first, *(number for number in ranked if number not in first)][:SHOWN])


def find_all(run: Run, work: Path, task: Task, town: str, frames: Sequence[int]) -> dict[str, list[Finding]]:
    """Return what the networks of each plan find in test frames of a town, by rule."""
    folder = Frames.open(work / run.steps.recording(town, "test", task.name)).data.folder
    threshold = SIGNS_FROM if task is SIGNS else OBJECTS_FROM
    found: dict[str, list[Finding]] = {}
    for rule in RULES:
        step = run.steps.stage(ARMS[rule], CLOUD, town, task.name)
        found[rule] = [*task.infer(load_network(task, work / step / WEIGHTS), folder, threshold, frames)]
    return found


def draw_stops(run: Run, work: Path) -> bytes | None:
    """Return the strip of stop signs as a PNG; None where no test frame under clouds has one."""
    split = Frames.open(work / run.steps.recording(STOP_TOWN, "test", SIGNS.name))
    frames = choose_stops(split.data, split.vehicles)
    if not frames:
        return None
    config = next(iter(SIGNS.configurations.values()))
    truths = SIGNS.samples(split.data, config, frames)

    def draw(axes: Axes, finding: Finding, column: int) -> None:
        height, width = finding.seen.shape[:2]
        axes.imshow(finding.seen, extent=(0, width, height, 0))
        for x1, y1, x2, y2 in truths[column].boxes.tolist():
            axes.add_patch(Rectangle((x1 - 3, y1 - 3), x2 - x1 + 6, y2 - y1 + 6, fill=False, edgecolor="white"))
        for mark in finding.marks:
            if isinstance(mark, PictureBoxes):
                boxes_in_picture(axes, mark)

    return draw_strip(find_all(run, work, SIGNS, STOP_TOWN, frames), draw, 1.6)


def draw_crossings(run: Run, work: Path) -> bytes:
    """Return the strip of cross-roads from above as a PNG; annotated road users are grey."""
    split = Frames.open(work / run.steps.recording(CROSS_TOWN, "test", OBJECTS.name))
    frames = choose_crossings(split.data, split.vehicles)
    truths = [near_boxes(split.data, number) for number in frames]

    def draw(axes: Axes, finding: Finding, column: int) -> None:
        axes.scatter(*on_page(finding.seen[:, :2]).T, s=0.3, color=style.POINT, linewidths=0, rasterized=True)
        draw_boxes(axes, truths[column], style.MUTED, fill=0.3, width=0.6)
        for mark in finding.marks:
            if isinstance(mark, CloudBoxes):
                draw_boxes(axes, mark.boxes, style.BLUE)
        axes.plot(0, 0, "^", color=style.INK, markersize=5)
        axes.set(xlim=(-REACH_M, REACH_M), ylim=(-REACH_M, REACH_M), aspect="equal")

    return draw_strip(find_all(run, work, OBJECTS, CROSS_TOWN, frames), draw, 2.3)


@style.styled
def draw_strip(
    found: Mapping[str, Sequence[Finding]], draw: Callable[[Axes, Finding, int], None], tall: float
) -> bytes:
    """Return a PNG with a row for each rule and a column for each frame, `tall` inches high a row."""
    columns = len(next(iter(found.values())))
    figure = style.canvas(10.0, tall * len(found) + 0.3)
    panels = figure.subplots(len(found), columns, squeeze=False)
    for (rule, findings), row in zip(found.items(), panels, strict=True):
        for column, (axes, finding) in enumerate(zip(row, findings, strict=True)):
            style.hide_axes(axes)
            draw(axes, finding, column)
        row[0].set_ylabel(rule, fontweight="bold")
    return style.png(figure, 130)


@style.styled
def draw_both(results: TrainedTriangles) -> bytes:
    """Return predicted and realised triangles side by side as a PNG."""
    figure = style.canvas(7.4, 3.8)
    panels = figure.subplots(1, 2)
    accuracies = {
        "predicted": {rule: results.predicted.triangles[rule].accuracy for rule in RULES},
        "realised": {rule: {task: own.accuracy[task].mean for task in TASKS} for rule, own in results.realised.items()},
    }
    for axes, (title, by_rule) in zip(panels, accuracies.items(), strict=True):
        draw_axes(axes)
        for rule, width in zip(RULES, (4.5, 2.8, 1.2), strict=True):
            draw_triangle(axes, by_rule[rule], color=COLOURS[rule], linewidth=width, label=rule)
        axes.set_title(title, fontweight="bold")
    style.key(figure, panels[0].get_legend_handles_labels()[0])
    return style.png(figure)


def tabulate_triangles(results: TrainedTriangles) -> dict[str, str]:
    """Return Markdown by name: triangles."""
    rows = []
    for rule, own in results.realised.items():
        predicted = results.predicted.triangles[rule]
        cells = (
            f"{'/'.join(map(str, own.plan[task]))}: {predicted.accuracy[task]:.3f}, {own.accuracy[task].describe()}"
            for task in TASKS
        )
        rows.append([rule, *cells, predicted.area.describe(), own.area.describe()])
    heads = ("rule", *(f"{task}: counts: predicted, realised" for task in TASKS), "area predicted", "area realised")
    return {"triangles": format_table(heads, rows)}


def _run(out: Path, options: Options) -> Outcome[TrainedTriangles]:
    recipe = options.load("triangle", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    (work,) = list_works(runs, out)[:1]
    results = compare_triangles(runs[0])
    pictures = {"triangles.png": draw_both(results), "crossings.png": draw_crossings(runs[0], work)}
    if (stops := draw_stops(runs[0], work)) is not None:
        pictures["stops.png"] = stops
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(TrainedTriangles, _run, tabulate_triangles, seeds=1, takes=("scale", "jobs", "engine", "stale"))
