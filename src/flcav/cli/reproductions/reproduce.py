"""`flcav reproduce`: the figures and comparisons of the article, and the tasks' studies."""

from pathlib import Path
from typing import Any

import click
import typer

from flcav.cli.options import ENGINE, JOBS, STALE, EngineName, Stale, join_choices, refuse_unused
from flcav.cli.reproductions.comparisons import COMPARISONS
from flcav.cli.reproductions.figures import write_figures
from flcav.cli.reproductions.targets import (
    COMMON_SEEDS,
    DRIVES,
    REAL,
    RECORDED,
    SEEDS,
    STUDY,
    TAKEN,
    TARGETS,
    TASK,
    Scale,
    Target,
)
from flcav.cli.terminal import echo, only_writer_of, when_interrupted
from flcav.config import InputError
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

OWN = "a task of your own that says how it is studied, as module:NAME"


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
        help="Number of seeds, from 1: 10 of federation-groups, 8 of corner-cases, federation-exchange and placement, "
        "5 of demo-arms, failure-search, lifelong, redundant-tasks and the other federation-*, 3 of the others if not "
        "given.",
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
    echo(f"{out / 'result.json'}: the numbers of {plural(count, 'seed')}")


@when_interrupted()
def _fig1b(out: Path) -> None:
    from flcav.experiments.fig1b.run import fig1b
    from flcav.interface import progress
    from flcav.storage.files import write_bytes

    with progress.show_progress("record") as report:
        picture = fig1b(out, report)
    write_bytes(out / "fig1b.png", picture)
    echo(f"{out / 'fig1b.png'}: four tasks on one scene")


def _fig3a(out: Path) -> None:
    from flcav.experiments.fig3a.run import draw_fig3a, fig3a
    from flcav.storage.files import write_bytes, write_json

    results = fig3a()
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "fig3a.png", draw_fig3a(results))
    for sentence in results.findings:
        echo(sentence)


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
    write_figures(out, results.as_json(), pictures, results.sentences())


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
        elif target == Target.federation_mixing:
            from flcav.experiments.attacks.withstood import repeat_withstood as repeat
        else:
            from flcav.experiments.attacks.leakage import repeat_leakage as repeat
        results, pictures = repeat(out, seeds, report)
    write_figures(out, results.as_json(), pictures, results.sentences())


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
            echo(f"{row.label} {row.kind} at IoU {row.iou}: {found}, {ap}")
    for line in describe_counts(results.counts or ()):
        echo(line)


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
            echo(f"{test}, {name}: {value.describe()}{spread}")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command()(reproduce)
