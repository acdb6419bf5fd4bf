"""flcav errors: what a network misses and invents, as `flcav place` reads it."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.choices import Device, TaskName, listed
from flcav.cli.options import AGENTS, THREADS
from flcav.cli.refusals import finite, refuse_unused
from flcav.threads import use_threads

if TYPE_CHECKING:
    from flcav.perception.errors import Registry
    from flcav.world.town import Town


PLURALS = {"miss": "missed", "false_positive": "false positives", "final_error": "final errors"}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(errors)


def errors(
    task: TaskName = typer.Argument(
        metavar="TASK", help=f"Whose errors: {listed(TaskName)}, of which weather's have no place in a town."
    ),
    data: Path = typer.Option(..., "--data", help="Dataset folder: where the network drives."),
    out: Path = typer.Option(..., "--out", help="The table to write: .csv or .parquet."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    threshold: float = typer.Option(
        0.3, "--threshold", min=0.0, max=1.0, callback=finite, help="objects, signs: lowest score of a detection."
    ),
    map_: Path | None = typer.Option(None, "--map", help="PNG file: the errors in the dataset's town."),
    agents: str | None = AGENTS,
    threads: int = THREADS,
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
) -> None:
    """Register what a network gets wrong on recorded frames.

    A row per object and cause; columns x, y, z [m, world], weight, kind, class, returns, occlusion, scene, track.
    Objects and signs: missed or invented; trajectory: a final error above 2 m, at the road user's present. Each object
    counts once per scene, each sign once. `flcav place` reads the table.
    """
    use_threads(threads)
    from flcav import progress
    from flcav.cli.tasks import network_of, origin_line, origin_of, task_named
    from flcav.config import InputError
    from flcav.dataset.exchange import check_ending
    from flcav.dataset.store import Dataset
    from flcav.files import check_writable, write_bytes
    from flcav.perception.agents import choose_frames
    from flcav.perception.errors import RegistersErrors, save_errors

    learned = task_named(task)
    if not isinstance(learned, RegistersErrors):
        raise InputError(f"task '{task}': its mistakes have no place in a town; choose objects, signs or trajectory")
    if task == TaskName.trajectory:
        refuse_unused(f"errors {task}", "threshold")
    check_ending(out)
    for path in (out, map_):
        if path is not None:
            check_writable(path.parent)
    dataset = Dataset.open(data)
    town = dataset.town()
    if map_ is not None and town is None:
        raise InputError(f"{data}: its town is not known, so that there is no map of it")
    network = network_of(learned, weights, device)
    chosen = choose_frames(learned, network.config, dataset, agents)
    typer.echo(f"{chosen.sentence}\n{origin_line(origin_of(learned, weights))}")
    with progress.live(f"errors of {task}") as report:
        found = learned.register_errors(network, dataset, chosen.frames, threshold, report)
    save_errors(found.errors, out)
    if map_ is not None and town is not None:
        write_bytes(map_, _draw(town, found))
    counts = Counter(error.kind for error in found.errors)
    told = ", ".join(f"{PLURALS[kind]}: {count}" for kind, count in counts.items())
    lost = f"; {found.dropped} false positives that point at nothing in the town left out" if found.dropped else ""
    typer.echo(f"{out}: {told or 'no errors'}{lost}")


def _draw(town: "Town", found: "Registry") -> bytes:
    import numpy as np

    from flcav.report import style
    from flcav.report.figures import town_map
    from flcav.report.maps import ErrorMap, poles_of

    xyz = np.array([(error.x, error.y, error.z) for error in found.errors]).reshape(-1, 3)
    kind = np.array([error.kind for error in found.errors], dtype=np.str_)
    return style.png(town_map(ErrorMap(town, xyz, kind, poles_of(town))))
