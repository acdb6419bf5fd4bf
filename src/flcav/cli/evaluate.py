"""flcav evaluate: how good a network is on a dataset."""

import json
from pathlib import Path

import typer

from flcav.cli.choices import Device, TaskName, listed


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


def evaluate(
    task: TaskName = typer.Argument(metavar="TASK", help=f"What was learned: {listed(TaskName)}."),
    data: Path = typer.Option(..., "--data", help="Dataset folder."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    tracks: bool = typer.Option(False, "--tracks", help="objects: also MOTA, AMOTA and id switches of their tracks."),
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Evaluate a network on recorded frames.

    Accuracy of weather, mAP of signs, average precision of objects, errors of predicted paths.
    """
    from flcav import progress
    from flcav.cli.tasks import network_of, task_named
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.perception.tracking.evaluate import evaluate_tracks, sequences, tracks_lines

    learner = task_named(task)
    if tracks and task != "objects":
        raise InputError(f"--tracks: only objects have tracks, not '{task}'")
    network = network_of(learner, weights, device)
    dataset = Dataset.open(data)
    if tracks:
        sequences(dataset)  # said before the long work
    with progress.live(f"evaluate {task}") as report:
        result = learner.evaluate(network, dataset, progress=report)
    lines = learner.evaluation_lines(result)
    if tracks:
        with progress.live("follow objects") as report:
            result = {**result, "tracks": evaluate_tracks(network, dataset, progress=report)}
        lines += tracks_lines(result["tracks"])
    typer.echo(json.dumps(result, allow_nan=False) if as_json else "\n".join(lines))
