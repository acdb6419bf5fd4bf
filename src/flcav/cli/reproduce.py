"""`flcav reproduce`: the figures and comparisons of the article, the tasks' studies, and users' own experiments."""

from pathlib import Path

import click
import typer

from flcav.cli.options import ENGINE, JOBS, STALE, EngineName, Stale, join_choices, refuse_unused
from flcav.cli.terminal import echo, only_writer_of, when_interrupted
from flcav.experiments import list_experiments
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads


@only_writer_of("out")
def reproduce(
    target: str = typer.Argument(
        ...,
        metavar="TARGET",
        help=f"What to reproduce: {join_choices(list_experiments())}, a task of your own that says "
        "how it is studied, as module:NAME, or a folder of your own with a run.py.",
    ),
    out: Path = typer.Option(..., "--out", help="Folder of the runs; the same command goes on after a stop."),
    seeds: int | None = typer.Option(
        None, "--seeds", min=1, help="Number of seeds, from 1; by default that of the committed page, 3 to 10."
    ),
    scale: str | None = typer.Option(
        None,
        "--scale",
        click_type=click.Choice(["quick", "paper", "full"]),
        help="full (or paper, the default): as committed; quick: in minutes.",
    ),
    jobs: int = JOBS,
    engine: EngineName = ENGINE,
    stale: Stale = STALE,
    kitti: Path | None = typer.Option(None, "--kitti", help="sim-to-real: a folder of real frames in KITTI's layout."),
    data: Path | None = typer.Option(
        None,
        "--data",
        help="sim-to-real: a dataset of real frames, such as an imported one, instead. real: a folder of frames that "
        "lie elsewhere.",
    ),
    around: bool = typer.Option(False, "--around", help="sim-to-real, with --data: look in all directions."),
    weights: Path | None = typer.Option(
        None,
        "--weights",
        help="sim-to-real: the detector's; by default those of the package. beams: those to begin with.",
    ),
) -> None:
    """Run what a figure of the article claims, or draw it; write result.json and a picture."""
    from flcav.cli.steps import live_steps
    from flcav.experiments.experiment import OPTIONS, Options, load_experiment
    from flcav.experiments.study import load_own_study, make_experiment
    from flcav.interface.progress import show_progress
    from flcav.storage.files import write_bytes, write_json

    use_threads(1)
    if ":" in target:
        experiment = make_experiment(load_own_study(target), lambda results: {})
    else:
        experiment = load_experiment(target)
    refuse_unused(f"reproduce {target}", *{*OPTIONS}.difference(experiment.takes))
    count = seeds or experiment.seeds
    how = (Path(target).name, count, scale == "quick", jobs, engine, stale, live_steps, show_progress)
    options = Options(*how, kitti=kitti, data=data, around=around, weights=weights)
    with when_interrupted():
        outcome = experiment.run(out, options)
    if outcome.results is not None:
        write_json(out / "result.json", experiment.encode(outcome.results), sort=False)
    for name, picture in outcome.pictures.items():
        write_bytes(out / name, picture)
    for sentence in outcome.sentences:
        echo(sentence)
    if "seeds" in experiment.takes:
        echo(f"{out / 'result.json'}: the numbers of {plural(count, 'seed')}")
