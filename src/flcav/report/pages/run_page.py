"""HTML page and pictures of a run, from its results and the files of its steps."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure

from flcav.config import Json
from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.federation.privacy import SEEDED
from flcav.geometry import Boxes
from flcav.network.clock.records import load_rounds
from flcav.perception.errors import load_errors
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.task import Scores
from flcav.perception.tasks import task_named
from flcav.plugins import load_named
from flcav.report import style
from flcav.report.charts import figures
from flcav.report.charts.timeline import timeline_of_rounds
from flcav.report.pages import html
from flcav.report.pictures import clouds, maps, perspective
from flcav.report.pictures.changes import ErrorChanges, draw_changes, look_from_poles
from flcav.report.pictures.sweep_scene import describe_sweep
from flcav.report.scene import SCENE, pack
from flcav.runs.analysis.answer import list_stage_means, tell_answer
from flcav.runs.analysis.caveats import PLACED_BARE
from flcav.runs.analysis.claims import ClaimRow, list_claims
from flcav.runs.analysis.costs import list_arm_costs, list_edge_points, list_home_costs
from flcav.runs.analysis.tiles import list_tiles
from flcav.runs.driving import CLOCK
from flcav.runs.frames import Frames
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import ArmCost, Run
from flcav.runs.results.saved import ERRORS
from flcav.runs.results.table import Row, tabulate
from flcav.runs.results.tests import WORDS, ErrorsAfter, SweepComparison, SweepDetections
from flcav.runs.results.training import TOGETHER
from flcav.runs.running import WORK
from flcav.runs.stages.testing import LOOK
from flcav.runs.training.records import list_rounds
from flcav.sensors.frame import Frame
from flcav.storage.files import write_bytes
from flcav.storage.records import select

OBJECTS, SWEEP, OVERVIEW = "objects", "before_after", "overview"
PHOTOS = (SWEEP, OVERVIEW)  # pictures of many points, which the page has as PNG files, the latter not at all
SHOWN_ROUNDS = 3  # number of rounds in a timeline
MOST_POINTS = 30_000  # of the sweep that the page draws


class DrawSection(Protocol):
    """Interface of functions that draw the pictures of a section."""

    def __call__(self, run: Run, /) -> dict[str, Figure]:
        """Return the pictures by name."""
        ...


def write_report(run: Run, out: Path | str) -> Path:
    """Write pictures/*.png and report.html of a run to its folder `out`, and return the path of the page.

    Raises `InputError` where the folders of its steps are missing.
    """
    out = Path(out)
    seen = read_seen(run, out / WORK)
    figures_ = draw(run, out / WORK, seen)
    pictures = {name: style.png(figure) for name, figure in figures_.items()}
    for name, png in pictures.items():
        write_bytes(out / "pictures" / f"{name}.png", png)
    drawings = {name: style.svg(figure) for name, figure in figures_.items() if name not in PHOTOS}
    shown = {name: pictures[name] for name in PHOTOS if name in pictures and name != OVERVIEW}
    write_bytes(out / "report.html", html.render(page(run, seen), shown, drawings=drawings).encode())
    return out / "report.html"


@dataclass(frozen=True)
class Seen:
    """Errors of a run before and after learning, by region, and the sweep that its page shows: from its steps."""

    changes: Mapping[str, ErrorChanges] = field(default_factory=dict)
    sweep: SweepComparison | None = None
    scene: Mapping[str, Json] | None = None  # this sweep as `scene.js` draws it


def read_seen(run: Run, work: Path) -> Seen:
    """Return the errors by region and the chosen sweep, those that the run has."""
    placed = run.arms[MAIN].placed
    changes = {place.region: found for place in placed if (found := read_changes(run, work, place)) is not None}
    if not (work / LOOK).is_dir():
        return Seen(changes)
    compared = SweepComparison.load(work / LOOK)
    stage = next((each.stage for each in run.arms[MAIN].stages if each.stage != PRETRAIN), EDGE)
    return Seen(
        changes, compared, describe_sweep(_read_frame(work, run, compared)[0], compared, stage, most=MOST_POINTS)
    )


def page(run: Run, seen: Seen | None = None) -> dict[str, Any]:
    """Return the values of the page for its template; `seen`: None where only the results are at hand."""
    recipe, main = run.recipe, run.arms[MAIN]
    claims = list_claims(run)
    return {
        **vars(main),
        **vars(run),
        "seen": seen or Seen(),
        "packed": _pack_scene(seen),
        "tasks": list(recipe.tasks),
        "from_scores": _list_thresholds(run),
        "regions": {role: recipe.with_role(role) for role in ("pretrain", "federate", "unseen")},
        "means": list_stage_means(run),
        "answer": tell_answer(run),
        "tiles": list_tiles(run),
        "claims": claims,
        "axis": _span(claims),
        "plans": main.plans,
        "uploads": {task: plan.uploads for task, plan in main.plan.tasks.items() if plan.uploads is not None},
        "made": {None: "before the run", PRETRAIN: "after stage I", EDGE: "after stage II"},
        "sent": {link: [main.sent_mb(task, link) for task in recipe.tasks] for link in main.links},
        "regional": [(arm, test) for arm, result in run.arms.items() for test in result.regional or ()],
        "rounds": [(stage, record) for arm, stage, record in list_rounds(run) if arm == MAIN],
        "words": WORDS,
        "labels": [
            (arm, stage.region, labels)
            for arm, result in run.arms.items()
            for stage in result.stages
            for labels in stage.labels or ()
        ],
        "timelines": _list_timelines(run),
        "together": TOGETHER,
        "seeded": SEEDED,
        "spent": {arm: result.privacy.describe() for arm, result in run.arms.items() if result.privacy is not None},
        "sections": run.list_sections(),
        "costs": _list_costs(run),
        "home": list_home_costs(run),
        "statistics": [(stage.task, scores) for stage in main.stages for scores in stage.statistics or ()],
        "caveats": [caveat for caveat in run.caveats if caveat != PLACED_BARE],
        "bare": PLACED_BARE if PLACED_BARE in run.caveats else None,
    }


def _list_thresholds(run: Run) -> dict[str, float]:
    """Return the score from which detections count, by task; of tasks whose counts have false ones alone."""
    counted = dict.fromkeys(count.task for count in run.counts or () if count.false is not None)
    return {name: task.threshold for name in counted if isinstance(task := task_named(name), Scores)}


def _pack_scene(seen: Seen | None) -> Mapping[str, str]:
    """Return the sweep and the script that draws it, packed; empty without a sweep."""
    if seen is None or seen.scene is None:
        return {}
    return {"sweep": pack(json.dumps(seen.scene)), "scene": pack(SCENE.read_text("utf-8"))}


def _span(claims: Sequence[ClaimRow]) -> tuple[float, float]:
    """Return the ends of the common axis of all differences, which has 0 within."""
    ends = [0.0]
    for row in claims:
        change = row.change
        ends += [change.mean, *(end for end in (change.low, change.high) if end is not None)]
    low, high = min(ends), max(ends)
    room = 0.04 * (high - low) or 0.01
    return low - room, high + room


def _list_costs(run: Run) -> Sequence[ArmCost]:
    return run.costs or list_arm_costs(run)


def draw(run: Run, work: Path, seen: Seen) -> dict[str, Figure]:
    """Return the pictures by name: maps, measures by round, timelines, traffic and others."""
    main = run.arms[MAIN]
    drawn = {f"map_{region}": draw_changes(changes) for region, changes in seen.changes.items()}
    rows = tabulate(run)
    charts = {task: _chart(run, rows, task) for task in run.recipe.tasks}
    for task, chart in charts.items():
        drawn[f"rounds_{_file_name(task)}"] = figures.by_round(*chart)
    drawn |= _timelines(run, work)
    for section in run.list_sections():
        drawn |= load_named("chart", section.chart, {section.chart: section.chart}, DrawSection)(run)
    budgets = {link: use.budget_mb for link, use in main.links.items()}
    drawn["megabytes"] = figures.megabytes(select(rows, arm=MAIN), budgets)
    costs = _list_costs(run)
    if any(cost.uplink_mb for cost in costs):
        drawn["gain"] = figures.gains(costs, list_edge_points(run))
    if seen.sweep is not None:
        sweep = _read_sweep(work, run, seen.sweep)
        drawn[SWEEP] = perspective.before_after(sweep)
        if seen.changes:
            drawn[OVERVIEW] = figures.overview(next(iter(seen.changes.values())), sweep, *charts[OBJECTS][1:])
    return drawn


def _timelines(run: Run, work: Path) -> dict[str, Figure]:
    """Return the timelines of the first rounds of stage II, as listed by `_list_timelines`; empty without a network."""
    task, names = next(iter(run.recipe.tasks)), run.steps
    drawn = {}
    for name, (arm, region) in _list_timelines(run).items():
        path = work / names.edge(arm, region, task) / f"{CLOCK}-{region}.parquet"
        records = load_rounds(path)[:SHOWN_ROUNDS] if path.exists() else ()
        if records:
            drawn[name] = timeline_of_rounds(records)
    return drawn


def _list_timelines(run: Run) -> dict[str, tuple[str, str]]:
    """Return arm and region of the stage-II federations of the first task, by picture; arms may share a federation."""
    task, names = next(iter(run.recipe.tasks)), run.steps
    listed = {}
    for arm, result in run.arms.items():
        for stage in result.stages:
            if stage.stage == EDGE and stage.region:
                end = stage.region if arm == MAIN else f"{stage.region}_{arm}"
                listed.setdefault(names.edge(arm, stage.region, task), (f"timeline_{end}", (arm, stage.region)))
    return dict(listed.values())


def _file_name(task: str) -> str:
    return task.replace(":", "_")


def read_changes(run: Run, work: Path, placed: Placed) -> ErrorChanges | None:
    """Return a region's errors and what became of them; None without a town, poles, or tasks of the placement."""
    names, tasks = run.steps, run.recipe.placement.tasks
    if not tasks or not placed.poles or not (work / names.remaining(placed.region, tasks[0])).is_dir():
        return None
    town = Frames.open(work / names.recording(placed.region, "registry", tasks[0])).data.town()
    if town is None:
        return None
    errors = [error for task in tasks for error in load_errors(work / names.errors(MAIN, placed.region, task) / ERRORS)]
    after = [ErrorsAfter.load(work / names.remaining(placed.region, task)) for task in tasks]
    at = np.array([(error.x, error.y, error.z) for error in errors]).reshape(-1, 3)
    poles = maps.poles_of(town)
    known = {str(pole.pole) for pole in placed.poles}
    viewsheds, seen = look_from_poles(town, poles, [str(pole) for pole in placed.chosen], at, placed.range_m)
    return ErrorChanges(
        town=town,
        errors=at,
        kind=np.array([error.kind for error in errors], dtype=np.str_),
        remains=np.array([one for each in after for one in each.remains], dtype=np.bool_),
        seen=seen,
        new=np.array([one for each in after for one in each.new]).reshape(-1, 3),
        new_kind=np.array([kind for each in after for kind in each.new_kinds], dtype=np.str_),
        poles={name: where for name, where in poles.items() if name in known},
        viewsheds=viewsheds,
    )


def _chart(run: Run, rows: Sequence[Row], task: str) -> tuple[list[Row], list[Row], str]:
    """Return the arguments of `figures.by_round` for a task."""
    starts = " + ".join(run.recipe.with_role("pretrain"))
    validated = select(rows, task=task, quantity="pretrained.validated.score")
    rounds = [replace(row, stage=PRETRAIN, region=starts) for row in validated]
    tested = select(rows, arm=MAIN, task=task, quantity="tested.estimate")
    return [*rounds, *select(rows, task=task, quantity="watched.rounds.score")], tested, tested[0].measure


def _read_sweep(work: Path, run: Run, looked: SweepComparison) -> clouds.ComparedSweep:
    frame, data = _read_frame(work, run, looked)
    points, ground_m = clouds.read_sweep(frame, choose_lidar(frame), DatasetGround(data).relief)
    before, after = _detections("Pretrained", looked.before), _detections("After edge FL", looked.after)
    return clouds.ComparedSweep(points, ground_m, _boxes(looked.targets), before, after)


def _read_frame(work: Path, run: Run, looked: SweepComparison) -> tuple[Frame, Dataset]:
    """Return the frame of the run's sweep, and its dataset."""
    region = run.recipe.with_role("federate")[0]
    data: Dataset = Frames.open(work / run.steps.recording(region, "test", OBJECTS)).data
    return data.frame(looked.frame), data


def _detections(title: str, seen: SweepDetections) -> clouds.MatchedDetections:
    return clouds.MatchedDetections(
        title, _boxes(seen.boxes), np.array(seen.hit, dtype=bool), np.array(seen.found, dtype=bool)
    )


def _boxes(rows: Sequence[Sequence[float]]) -> Boxes:
    return Boxes.from_array(np.array(rows, dtype=np.float64).reshape(-1, 7), "Car")
