"""`flcav reproduce`: the figures and comparisons of the article, and the tasks' studies."""

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import typer

from flcav.cli.options import ENGINE, JOBS, STALE, EngineName, Stale, join_choices, refuse_unused
from flcav.cli.terminal import only_writer_of, when_interrupted
from flcav.config import InputError
from flcav.experiments.studies import STUDIES
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.config import Json
    from flcav.pipeline.recipe import RunRecipe
    from flcav.pipeline.results.run import Run

RUN = ("jobs", "engine", "stale")  # options of targets that run as steps
STUDY = ("seeds", "scale", *RUN)  # options of targets that run over seeds
REAL = ("kitti", "data", "around", "weights")  # options of sim-to-real
TASK = "task-"  # before the name of a task's study
OWN = "a task of your own that says how it is studied, as module:NAME"
COMMON_SEEDS = 3
IMPORTED = "quarter"  # map of the package, imported into the folder of the proof of placement


class Target(StrEnum):
    """Targets other than the tasks' studies."""

    corner_cases = "corner-cases"
    demo_arms = "demo-arms"
    distillation = "distillation"
    failure_search = "failure-search"
    federation_asynchrony = "federation-asynchrony"
    federation_exchange = "federation-exchange"
    federation_exchange_objects = "federation-exchange-objects"
    federation_faults = "federation-faults"
    federation_groups = "federation-groups"
    federation_leakage = "federation-leakage"
    fig1b = "fig1b"
    fig3a = "fig3a"
    fig3b = "fig3b"
    fig4 = "fig4"
    fig6a_allocation = "fig6a-allocation"
    gap = "gap"
    lifelong = "lifelong"
    networks = "networks"
    placement = "placement"
    redundant_tasks = "redundant-tasks"
    road_average = "road-average"
    road_detector = "road-detector"
    safety_distance = "safety-distance"
    sensor_ranges = "sensor-ranges"
    sim_to_real = "sim-to-real"


RECORDED = (  # recordings, no training
    Target.fig3b,
    Target.fig4,
    Target.road_average,
    Target.road_detector,
    Target.sensor_ranges,
)
EXCHANGES: Mapping[str, str] = {  # recipe of each
    Target.federation_exchange: "exchange",
    Target.federation_exchange_objects: "exchange_objects",
}
DRIVES = (  # one recording, several seeds
    Target.federation_asynchrony,
    Target.federation_faults,
    Target.federation_groups,
    Target.federation_leakage,
)


class Scale(StrEnum):
    """Scale of a reproduction."""

    quick = "quick"
    paper = "paper"
    full = "full"


TARGETS: tuple[str, ...] = (*(target.value for target in Target), *(f"{TASK}{name}" for name in STUDIES))
TAKEN: Mapping[str, tuple[str, ...]] = dict.fromkeys(TARGETS, STUDY) | {
    Target.fig1b: (),
    Target.fig3a: (),
    **dict.fromkeys(RECORDED, ()),
    **dict.fromkeys(DRIVES, ("seeds",)),
    Target.failure_search: ("seeds", "scale"),
    Target.safety_distance: ("seeds", "scale", "jobs"),
    Target.sim_to_real: (*RUN, *REAL),
}
SEEDS: Mapping[str, int] = {
    **dict.fromkeys(
        (
            *(Target.corner_cases, Target.demo_arms, Target.failure_search, Target.lifelong, Target.redundant_tasks),
            *(*EXCHANGES, *DRIVES),
        ),
        5,
    ),
    **dict.fromkeys((Target.federation_exchange, Target.placement), 8),
    Target.federation_groups: 10,
    Target.safety_distance: 1,
}


class Reproducible(click.Choice):
    """Choice of one of `TARGETS`, or a user's own as module:NAME."""

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the target; raises `click.BadParameter` for an unknown one."""
        return value if ":" in value else super().convert(value, param, ctx)


@only_writer_of("out")
def reproduce(
    target: str = typer.Argument(
        ...,
        metavar="TARGET",
        click_type=Reproducible(TARGETS),
        help=f"What to reproduce: {join_choices(TARGETS)}, or {OWN}.",
    ),
    out: Path = typer.Option(..., "--out", help="Folder of the runs; the same command goes on after a stop."),
    seeds: int | None = typer.Option(
        None,
        "--seeds",
        min=1,
        help="Number of seeds, from 1: 10 of federation-groups, 8 of federation-exchange and placement, 5 of "
        "corner-cases, demo-arms, failure-search, lifelong, redundant-tasks and the other federation-*, 3 of the "
        "others if not given.",
    ),
    scale: Scale | None = typer.Option(
        None, "--scale", help="full (or paper, the default): as committed; quick: in minutes."
    ),
    jobs: int = JOBS,
    engine: EngineName = ENGINE,
    stale: Stale = STALE,
    kitti: Path | None = typer.Option(None, "--kitti", help="sim-to-real: a folder of real frames in KITTI's layout."),
    data: Path | None = typer.Option(
        None, "--data", help="sim-to-real: a dataset of real frames, such as an imported one, instead."
    ),
    around: bool = typer.Option(False, "--around", help="sim-to-real, with --data: look in all directions."),
    weights: Path | None = typer.Option(
        None, "--weights", help="sim-to-real: the detector's; by default those of the package."
    ),
) -> None:
    """Run what a figure of the article claims, or draw it; write result.json and a picture."""
    use_threads(1)
    refuse_unused(f"reproduce {target}", *{*STUDY, *REAL}.difference(TAKEN.get(target, STUDY)))
    if target in (Target.fig1b, Target.fig3a):
        draw = _fig1b if target == Target.fig1b else _fig3a
        draw(out)
        return
    if target in RECORDED:
        _record_and_draw(Target(target), out)
        return
    if target == Target.sim_to_real:
        if (kitti is None) == (data is None):
            raise InputError("sim-to-real needs real frames: --kitti, a folder in KITTI's layout, or --data, a dataset")
        _sim_to_real(out, kitti or data or Path(), weights, around, jobs, engine, stale)
        return
    count = seeds or SEEDS.get(target, COMMON_SEEDS)
    if target in DRIVES:
        _repeat_drives(Target(target), out, count)
        return
    numbers = range(1, count + 1)
    quick = scale == Scale.quick
    if target.startswith(TASK) or ":" in target:
        _task(target, out, numbers, "quick" if quick else "full", jobs, engine, stale)
    else:
        COMPARISONS[target](out, count, "quick" if quick else "paper", jobs, engine, stale)
    typer.echo(f"{out / 'result.json'}: the numbers of {plural(count, 'seed')}")


@when_interrupted()
def _fig1b(out: Path) -> None:
    from flcav.experiments.fig1b.run import fig1b
    from flcav.interface import progress
    from flcav.storage.files import write_bytes

    with progress.show_progress("record") as report:
        picture = fig1b(out, report)
    write_bytes(out / "fig1b.png", picture)
    typer.echo(f"{out / 'fig1b.png'}: four tasks on one scene")


def _fig3a(out: Path) -> None:
    from flcav.experiments.fig3a.run import draw_fig3a, fig3a
    from flcav.storage.files import write_bytes, write_json

    results = fig3a()
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "fig3a.png", draw_fig3a(results))
    for sentence in results.findings:
        typer.echo(sentence)


@when_interrupted()
def _record_and_draw(target: Target, out: Path) -> None:
    from flcav.interface import progress

    with progress.show_progress(target.value) as report:
        if target == Target.fig3b:
            from flcav.experiments.fig3b.run import fig3b as repeat
        elif target == Target.fig4:
            from flcav.experiments.roadside.fig4 import fig4 as repeat
        elif target == Target.sensor_ranges:
            from flcav.experiments.roadside.ranges import measure_ranges as repeat
        elif target == Target.road_average:
            from flcav.experiments.roadside.average import evaluate_road_average as repeat
        else:
            from flcav.experiments.roadside.detector import evaluate_road_detector as repeat
        results, pictures = repeat(out, report)
    _write_figures(out, results.as_json(), pictures, results.sentences())


@when_interrupted()
def _repeat_drives(target: Target, out: Path, seeds: int) -> None:
    from flcav.interface import progress

    with progress.show_progress(target.value) as report:
        if target == Target.federation_asynchrony:
            from flcav.experiments.asynchrony.run import compare_asynchrony as repeat
        elif target == Target.federation_faults:
            from flcav.experiments.attacks.faults import repeat_faults as repeat
        elif target == Target.federation_groups:
            from flcav.experiments.groups.run import compare_groups as repeat
        else:
            from flcav.experiments.attacks.leakage import repeat_leakage as repeat
        results, pictures = repeat(out, seeds, report)
    _write_figures(out, results.as_json(), pictures, results.sentences())


def _write_figures(out: Path, numbers: "Json", pictures: Mapping[str, bytes], sentences: Sequence[str]) -> None:
    """Write numbers and pictures, and say what was found."""
    from flcav.storage.files import write_bytes, write_json

    write_json(out / "result.json", numbers)
    for name, picture in pictures.items():
        write_bytes(out / name, picture)
    for sentence in sentences:
        typer.echo(sentence)


def _demo_arms(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.arms.run import compare_arms, draw_arms, judge_differences
    from flcav.storage.files import write_bytes, write_json

    results = compare_arms(*_run_seeds(Target.demo_arms, "arms", out, seeds, scale, jobs, engine, stale))
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "arms.png", draw_arms(results))
    for arm, closed in results.summary.gap_closed.items():
        typer.echo(f"{arm}: closes of the gap {closed.describe()}")
    if results.summary.road_share is not None:
        typer.echo(f"share of the gain with an ideal road detector: {results.summary.road_share.describe()}")
    for name, judged in judge_differences(results.summary).items():
        typer.echo(
            f"{name}: {results.summary.differences[name].describe(sign=True)}, {judged.verdict}: {judged.describe()}"
        )


@when_interrupted()
def _fig6a_allocation(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.fig6a.run import BUDGETS, budget_recipes, compare_plans, draw_allocation, plans_differ
    from flcav.pipeline.running import run_several
    from flcav.storage.files import write_bytes, write_json

    recipe = _load_sized("allocation", scale)
    with live_steps(Target.fig6a_allocation.value) as notify:

        def finish(numbers: Sequence[int], factors: Sequence[float]) -> "dict[float, list[Run]]":
            recipes = budget_recipes(recipe, numbers, factors)
            runs = iter(run_several(recipes, out, jobs=jobs, notify=notify, stale=stale, engine=engine))
            return {factor: [next(runs) for _ in numbers] for factor in factors}

        first = finish([1], BUDGETS)
        others = finish(range(2, seeds + 1), [factor for factor, (run,) in first.items() if plans_differ(run)])
    results = compare_plans(recipe, {factor: [*own, *others.get(factor, [])] for factor, own in first.items()})
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "plans.png", draw_allocation(results))
    for each in results.budgets:
        for finding in each.findings:
            typer.echo(f"Budgets {each.name}. {finding.question} {finding.verdict}. {finding.sentence}")


def _distillation(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.distillation.run import compare_labels, draw_labels

    results = compare_labels(*_run_seeds(Target.distillation, "distillation", out, seeds, scale, jobs, engine, stale))
    _write_figures(out, results.as_json(), {"arms.png": draw_labels(results)}, results.sentences())


def _gap(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.gap.megabytes import trace_bytes
    from flcav.experiments.gap.run import TOWN, compare_gap, draw_gap, draw_megabytes
    from flcav.experiments.scales import shrink_recipe
    from flcav.pipeline.running import WORK

    recipe, runs = _run_seeds(Target.gap, "gap", out, seeds, scale, jobs, engine, stale, shrink_recipe)
    curves = [trace_bytes(run, out / f"seed{run.recipe.seed}" / WORK, TOWN) for run in runs]
    results = compare_gap(recipe, runs, curves)
    pictures = {"arms.png": draw_gap(results), "megabytes.png": draw_megabytes(results)}
    _write_figures(out, results.as_json(), pictures, results.sentences())


@when_interrupted()
def _networks(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.networks.run import draw_networks, search_networks

    with live_steps(Target.networks.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        results = search_networks(out, seeds=range(1, seeds + 1), quick=scale != "paper", **how)
    _write_figures(out, results.as_json(), {"networks.png": draw_networks(results)}, results.sentences())


@when_interrupted()
def _redundant_tasks(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.redundant_tasks.run import compare_splits

    with live_steps(Target.redundant_tasks.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        results = compare_splits(out, seeds=range(1, seeds + 1), quick=scale != "paper", **how)
    _write_figures(out, results.as_json(), {"splits.png": results.picture()}, results.sentences())


def _federation_exchange(
    target: Target, out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale
) -> None:
    from flcav.experiments.exchanges.run import compare_exchanges, draw_results
    from flcav.experiments.scales import shrink_recipe

    recipe, runs = _run_seeds(target, EXCHANGES[target], out, seeds, scale, jobs, engine, stale, shrink_recipe)
    results = compare_exchanges(recipe, runs, [out / f"seed{run.recipe.seed}" for run in runs])
    _write_figures(out, results.as_json(), {"exchange.png": draw_results(results)}, results.sentences())


def _placement(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.maps import import_map
    from flcav.experiments.placement.claims import describe_claims
    from flcav.experiments.placement.overlaps import describe_overlaps, list_overlaps
    from flcav.experiments.placement.run import draw_proof, list_regions, prove_placement
    from flcav.experiments.scales import shrink_recipe
    from flcav.pipeline.running import WORK

    asked = _load_sized("placement", scale, shrink_recipe)
    import_map(IMPORTED, out)
    overlaps = {region: list_overlaps(asked, region, out) for region in list_regions(asked)}
    for sentence in describe_overlaps(overlaps, asked.placement.range_m):
        typer.echo(sentence)
    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe, out)
    recipe, runs = _run_seeds(Target.placement, "placement", out, *how)
    results = prove_placement(recipe, runs, [out / f"seed{run.recipe.seed}" / WORK for run in runs], out)
    _write_figures(out, results.as_json(), draw_proof(results), [*results.sentences(), *describe_claims(results)])


@when_interrupted()
def _safety_distance(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.safety_distance.run import SCENARIOS, compare_margins
    from flcav.interface import progress

    with progress.show_progress(Target.safety_distance.value) as report:
        results = compare_margins(out, seeds, jobs, report, SCENARIOS if scale == "paper" else 2)
    _write_figures(out, results.as_json(), {"trade_off.png": results.picture()}, results.sentences())


@when_interrupted()
def _failure_search(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.failure_search.run import SCENARIOS, compare_searches
    from flcav.interface import progress

    with progress.show_progress(Target.failure_search.value) as report:
        results = compare_searches(out, seeds, SCENARIOS if scale == "paper" else 4, report)
    _write_figures(out, results.as_json(), {"growth.png": results.picture()}, results.sentences())


def _corner_cases(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.corner_cases.run import compare_corner_cases, draw_corner_cases
    from flcav.experiments.scales import shrink_recipe
    from flcav.interface import progress
    from flcav.pipeline.running import WORK

    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe)
    recipe, runs = _run_seeds(Target.corner_cases, "corner_cases", out, *how)
    works = [out / f"seed{run.recipe.seed}" / WORK for run in runs]
    with progress.show_progress("rare kinds") as report:
        results = compare_corner_cases(recipe, runs, works, report)
    _write_figures(out, results.as_json(), {"arms.png": draw_corner_cases(results)}, results.sentences())


def _lifelong(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.lifelong.run import compare_lifelong, draw_lifelong
    from flcav.experiments.scales import shrink_recipe

    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe)
    results = compare_lifelong(*_run_seeds(Target.lifelong, "lifelong", out, *how))
    _write_figures(out, results.as_json(), {"lifelong.png": draw_lifelong(results)}, results.sentences())


COMPARISONS: Mapping[str, Callable[[Path, int, str, int, EngineName, Stale], None]] = {
    Target.corner_cases: _corner_cases,
    Target.demo_arms: _demo_arms,
    Target.distillation: _distillation,
    **{target: partial(_federation_exchange, Target(target)) for target in EXCHANGES},
    Target.failure_search: _failure_search,
    Target.fig6a_allocation: _fig6a_allocation,
    Target.gap: _gap,
    Target.lifelong: _lifelong,
    Target.networks: _networks,
    Target.placement: _placement,
    Target.redundant_tasks: _redundant_tasks,
    Target.safety_distance: _safety_distance,
}


@when_interrupted()
def _run_seeds(
    target: Target,
    name: str,
    out: Path,
    seeds: int,
    scale: str,
    jobs: int,
    engine: EngineName,
    stale: Stale,
    shrink: "Callable[[RunRecipe], RunRecipe] | None" = None,
    beside: Path | None = None,
) -> "tuple[RunRecipe, tuple[Run, ...]]":
    """Run or finish the package's recipe `runs/<name>` with several seeds, as `_load_sized` returns it.

    Imported towns are looked for in `beside`.
    """
    from flcav.cli.steps import live_steps
    from flcav.pipeline.running import run_seeds

    recipe = _load_sized(name, scale, shrink)
    with live_steps(target.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        runs, _ = run_seeds(recipe, out, seeds=seeds, beside=beside, **how)
    return recipe, runs


def _load_sized(name: str, scale: str, shrink: "Callable[[RunRecipe], RunRecipe] | None" = None) -> "RunRecipe":
    """Return the package's recipe `runs/<name>`; unless scale is paper, `shrink` of it (None: at the demo's size)."""
    from flcav.experiments.scales import use_demo_size
    from flcav.pipeline.recipe import load_run_recipe
    from flcav.sources.recipe import recipe_path

    recipe = load_run_recipe(recipe_path(f"runs/{name}"))
    return recipe if scale == "paper" else (shrink or use_demo_size)(recipe)


@when_interrupted()
def _sim_to_real(
    out: Path, real: Path, weights: Path | None, around: bool, jobs: int, engine: EngineName, stale: Stale
) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.sim_to_real.run import draw_clouds, draw_frame, run_sim_to_real
    from flcav.perception.metrics import interval_words
    from flcav.perception.metrics.operating_point import describe_counts
    from flcav.perception.networks import resolve_network
    from flcav.perception.objects.task import OBJECTS
    from flcav.storage.files import write_bytes, write_json

    with live_steps(Target.sim_to_real.value) as notify:
        network = resolve_network(OBJECTS, weights)
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        results = run_sim_to_real(network, real, out, around=around, **how)
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "clouds.png", draw_clouds(results))
    for story in results.frames:
        if (picture := draw_frame(real, story)) is not None:
            write_bytes(out / f"{story.frame}.png", picture)
    for row in results.scores:
        if row.targets:
            found = f"{row.found} of {row.targets} found, {row.false_positives} false"
            ap = f"AP {row.ap:.3f} {interval_words(row.low, row.high)}"
            typer.echo(f"{row.label} {row.kind} at IoU {row.iou}: {found}, {ap}")
    for line in describe_counts(results.counts or ()):
        typer.echo(line)


@when_interrupted()
def _task(target: str, out: Path, seeds: range, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.studies import study_named
    from flcav.experiments.studies.run import results_as_json, run_study
    from flcav.storage.files import write_bytes, write_json

    study = study_named(target.removeprefix(TASK))
    with live_steps(target) as notify:
        results = run_study(study, out, seeds=seeds, scale=scale, jobs=jobs, notify=notify, stale=stale, engine=engine)
    write_json(out / "result.json", results_as_json(study, results))
    write_bytes(out / f"{study.task.name}.png", study.draw(results))
    for test, numbers in results.summary.items():
        for name, value in numbers.items():
            spread = f", standard deviation over seeds {value.sd:.3f}" if value.seeds > 1 else ""
            typer.echo(f"{test}, {name}: {value.describe()}{spread}")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command()(reproduce)
