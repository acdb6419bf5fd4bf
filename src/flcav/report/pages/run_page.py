"""HTML page and pictures of a run, from its results and the files of its steps."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure

from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.federation.privacy import SEEDED
from flcav.geometry import Boxes
from flcav.network.clock.records import load_rounds
from flcav.perception.errors import PerceptionError, load_errors
from flcav.perception.objects.truth import choose_lidar
from flcav.plugins import load_named
from flcav.report import style
from flcav.report.charts import figures
from flcav.report.charts.timeline import timeline_of_rounds
from flcav.report.pages import html
from flcav.report.pictures import clouds, maps
from flcav.runs.analysis.answer import list_stage_means, tell_answer
from flcav.runs.analysis.caveats import PLACED_BARE
from flcav.runs.analysis.costs import list_arm_costs, list_home_costs
from flcav.runs.arms import Names
from flcav.runs.driving import CLOCK
from flcav.runs.frames import Frames
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import ArmCost, Run
from flcav.runs.results.saved import ERRORS
from flcav.runs.results.table import Row, tabulate
from flcav.runs.results.tests import WORDS, SweepComparison, SweepDetections
from flcav.runs.results.training import TOGETHER
from flcav.runs.running import WORK
from flcav.runs.stages.testing import LOOK
from flcav.runs.training.records import list_rounds
from flcav.storage.files import write_bytes
from flcav.storage.records import select

OBJECTS = "objects"
SHOWN_ROUNDS = 3  # number of rounds in a timeline


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
    pictures = draw(run, out / WORK)
    for name, png in pictures.items():
        write_bytes(out / "pictures" / f"{name}.png", png)
    shown = {name: png for name, png in pictures.items() if name != "overview"}
    write_bytes(out / "report.html", html.render(page(run), shown).encode())
    return out / "report.html"


def page(run: Run) -> dict[str, Any]:
    """Return the values of the page for its template."""
    recipe, main = run.recipe, run.arms[MAIN]
    return {
        **vars(main),
        **vars(run),
        "tasks": list(recipe.tasks),
        "regions": {role: recipe.with_role(role) for role in ("pretrain", "federate", "unseen")},
        "stages": list_stage_means(run),
        "answer": tell_answer(run),
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


def _list_costs(run: Run) -> Sequence[ArmCost]:
    return run.costs or list_arm_costs(run)


def draw(run: Run, work: Path) -> dict[str, bytes]:
    """Return the pictures as PNG files by name: maps, measures by round, timelines, traffic and others."""
    main = run.arms[MAIN]
    drawn = {}
    scenes = [(placed, scene) for placed in main.placed if (scene := _map(run, work, placed)) is not None]
    for placed, scene in scenes:
        drawn[f"map_{placed.region}"] = figures.town_map(scene)
    rows = tabulate(run)
    charts = {task: _chart(run, rows, task) for task in run.recipe.tasks}
    for task, chart in charts.items():
        drawn[f"rounds_{_file_name(task)}"] = figures.by_round(*chart)
    drawn |= _timelines(run, work)
    for section in run.list_sections():
        drawn |= load_named("chart", section.chart, {section.chart: section.chart}, DrawSection)(run)
    budgets = {link: use.budget_mb for link, use in main.links.items()}
    drawn["megabytes"] = figures.megabytes(select(rows, arm=MAIN), budgets)
    if costs := [cost for cost in _list_costs(run) if cost.gain_per_mb is not None]:
        drawn["gain"] = figures.gains(costs)
    sweep = _sweep(work, run.steps, run) if (work / LOOK).is_dir() else None
    if sweep is not None:
        drawn["before_after"] = figures.before_after(sweep)
        if scenes:
            drawn["overview"] = figures.overview(scenes[0][1], sweep, *charts[OBJECTS])
    return {name: style.png(figure) for name, figure in drawn.items()}


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


def _map(run: Run, work: Path, placed: Placed) -> maps.ErrorMap | None:
    """Return the map of a region's errors and poles; None without a town, poles, or tasks of the placement."""
    names, tasks = run.steps, run.recipe.placement.tasks
    if not tasks:
        return None
    drive = Frames.open(work / names.recording(placed.region, "registry", tasks[0])).data
    town = drive.town()
    if town is None or not placed.poles:
        return None
    errors: list[PerceptionError] = []
    for task in tasks:
        errors += load_errors(work / names.errors(MAIN, placed.region, task) / ERRORS)
    return maps.ErrorMap(
        town,
        np.array([(error.x, error.y, error.z) for error in errors]).reshape(-1, 3),
        np.array([error.kind for error in errors], dtype=np.str_),
        {number: at for number, at in maps.poles_of(town).items() if int(number) in {p.pole for p in placed.poles}},
        {str(pole): placed.range_m for pole in placed.chosen},
        conventional={maps.DENSEST: (str(placed.densest),)},
    )


def _chart(run: Run, rows: Sequence[Row], task: str) -> tuple[list[Row], list[Row], str]:
    """Return the arguments of `figures.by_round` for a task."""
    starts = " + ".join(run.recipe.with_role("pretrain"))
    validated = select(rows, task=task, quantity="pretrained.validated.score")
    rounds = [replace(row, stage=PRETRAIN, region=starts) for row in validated]
    tested = select(rows, arm=MAIN, task=task, quantity="tested.estimate")
    return [*rounds, *select(rows, task=task, quantity="watched.rounds.score")], tested, tested[0].measure


def _sweep(work: Path, names: Names, run: Run) -> clouds.ComparedSweep:
    looked = SweepComparison.load(work / LOOK)
    region = run.recipe.with_role("federate")[0]
    data: Dataset = Frames.open(work / names.recording(region, "test", OBJECTS)).data
    frame = data.frame(looked.frame)
    points, ground_m = clouds.read_sweep(frame, choose_lidar(frame), DatasetGround(data).relief)
    before, after = _detections("pretrained", looked.before), _detections("after the last stage", looked.after)
    return clouds.ComparedSweep(points, ground_m, _boxes(looked.targets), before, after)


def _detections(title: str, seen: SweepDetections) -> clouds.MatchedDetections:
    return clouds.MatchedDetections(
        title, _boxes(seen.boxes), np.array(seen.hit, dtype=bool), np.array(seen.found, dtype=bool)
    )


def _boxes(rows: Sequence[Sequence[float]]) -> Boxes:
    return Boxes.from_array(np.array(rows, dtype=np.float64).reshape(-1, 7), "Car")
