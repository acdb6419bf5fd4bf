"""`flcav evaluate`: evaluate a network on a dataset."""

from pathlib import Path

import typer

from flcav.cli.options import AGENTS, ANY_TASK, AROUND, THREADS, Device
from flcav.cli.terminal import echo, print_json
from flcav.machine.threads import use_threads


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


def evaluate(
    task: str = typer.Argument(metavar="TASK", help=f"What was learned: {ANY_TASK}."),
    data: Path = typer.Option(..., "--data", help="Dataset folder; objects: or one in KITTI's layout."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    tracks: bool = typer.Option(False, "--tracks", help="objects: also MOTA, AMOTA and id switches of their tracks."),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    within: str | None = typer.Option(
        None,
        "--range",
        metavar="AHEAD,SIDE",
        help="objects: ask only for those so many metres ahead and to either side, as 48,24; by default the network's "
        "range. Networks of different ranges are compared so.",
    ),
    threads: int = THREADS,
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Evaluate a network on recorded frames.

    Accuracy of weather, mAP of signs, average precision of objects, errors of predicted paths. Objects in a folder of
    KITTI are counted as its benchmark does: easy, moderate, hard.
    """
    use_threads(threads)
    from flcav.interface import progress
    from flcav.perception import networks
    from flcav.perception.tasks import task_named

    learned = task_named(task)
    with progress.show_progress(f"evaluate {learned.name}") as report:
        found = networks.evaluate(
            learned,
            data,
            weights,
            agents=agents,
            within=within,
            around=around,
            tracks=tracks,
            device=device,
            threads=threads,
            progress=report,
        )
    origin = networks.origin_of(learned, weights)
    if as_json:
        print_json(vars(origin) | found.chosen.summary() | dict(found.numbers))
        return
    echo("\n".join([found.chosen.sentence, str(origin), *found.lines]))
