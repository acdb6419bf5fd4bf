"""`flcav errors`: register a network's errors, as a table for `flcav place`."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import AGENTS, ANY_TASK, AROUND, THREADS, Device, check_finite, check_png, refuse_unused
from flcav.cli.terminal import echo
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.perception.errors import Registry
    from flcav.world.map.town import Town


PLURALS = {"miss": "missed", "false_positive": "false positives", "final_error": "final errors"}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(errors)


def errors(
    task: str = typer.Argument(metavar="TASK", help=f"Whose errors: {ANY_TASK}; weather's have no place in a town."),
    data: Path = typer.Option(..., "--data", help="Dataset folder: where the network drives."),
    out: Path = typer.Option(..., "--out", help="The table to write: .csv or .parquet."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    threshold: float | None = typer.Option(
        None,
        "--threshold",
        min=0.0,
        max=1.0,
        callback=check_finite,
        help="objects, signs: lowest score of a detection; 0.3 if not given.",
    ),
    map_: Path | None = typer.Option(
        None, "--map", callback=check_png, help="PNG file: the errors in the dataset's town."
    ),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    threads: int = THREADS,
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
) -> None:
    """Register what a network gets wrong on recorded frames.

    A row per object and cause; columns x, y, z [m, world], weight, kind, class, returns, occlusion, scene, track.
    Objects and signs: missed or invented; trajectory: a final error above 2 m, at the road user's present. Each object
    counts once per scene, each sign once. `flcav place` reads the table.
    """
    use_threads(threads)
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.perception import networks
    from flcav.perception.errors import save_errors
    from flcav.perception.objects.task import ObjectsTask
    from flcav.perception.task import Scores
    from flcav.perception.tasks import task_named
    from flcav.storage.files import check_writable, write_bytes
    from flcav.storage.records import check_ending

    learned = task_named(task)
    if not isinstance(learned, Scores):
        refuse_unused(f"errors {task}", "threshold")
    if not isinstance(learned, ObjectsTask):
        refuse_unused(f"errors {task}", "around")
    check_ending(out)
    for path in (out, map_):
        if path is not None:
            check_writable(path.parent)
    dataset = Dataset.open(data)
    town = dataset.town()
    if map_ is not None and town is None:
        raise InputError(f"{data}: its town is not known, so that there is no map of it")
    with progress.show_progress(f"errors of {learned.name}") as report:
        found = networks.register_errors(
            learned, dataset, weights, threshold=threshold, around=around, agents=agents, device=device, progress=report
        )
    save_errors(found.errors, out)
    if map_ is not None and town is not None:
        write_bytes(map_, _draw(town, found))
    if found.chosen is not None:
        echo(found.chosen.sentence)
    echo(networks.origin_of(learned, weights))
    counts = Counter(error.kind for error in found)
    told = ", ".join(f"{PLURALS.get(kind, kind)}: {count}" for kind, count in counts.items())
    lost = f"; {found.dropped} false positives that point at nothing in the town left out" if found.dropped else ""
    echo(f"{out}: {told or 'no errors'}{lost}")


def _draw(town: "Town", found: "Registry") -> bytes:
    from flcav.report import style
    from flcav.report.charts.figures import town_map
    from flcav.report.pictures.maps import ErrorMap, poles_of

    return style.png(town_map(ErrorMap(town, found.positions, found.kinds, poles_of(town))))
