"""flcav evaluate: how good a network is on a dataset."""

import json
from pathlib import Path

import typer

from flcav.cli.choices import Device, TaskName, listed
from flcav.cli.options import AGENTS, THREADS
from flcav.threads import use_threads


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
    agents: str | None = AGENTS,
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

    Accuracy of weather, mAP of signs, average precision of objects, errors of predicted paths.
    """
    use_threads(threads)
    from flcav import progress
    from flcav.cli.tasks import network_of, origin_line, origin_of, task_named
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.perception.agents import choose_frames
    from flcav.perception.objects.area import narrowed
    from flcav.perception.tracking.evaluate import evaluate_tracks, sequences, tracks_lines

    learner = task_named(task)
    if tracks and task != "objects":
        raise InputError(f"--tracks: only objects have tracks, not '{task}'")
    if within is not None and task != "objects":
        raise InputError(f"--range: only objects lie in a range, not '{task}'")
    network = network_of(learner, weights, device)
    dataset = Dataset.open(data)
    chosen = choose_frames(learner, network.config, dataset, agents)
    narrow = {} if within is None else {"asked": narrowed(network.config, within)}
    if tracks:
        sequences(dataset, chosen.frames)  # said before the long work
    with progress.live(f"evaluate {task}") as report:
        result = learner.evaluate(network, dataset, chosen.frames, **narrow, progress=report)
    origin = origin_of(learner, weights)
    lines = [chosen.sentence, origin_line(origin), *learner.evaluation_lines(result)]
    result = origin | chosen.summary() | result
    if tracks:
        with progress.live("follow objects") as report:
            result["tracks"] = evaluate_tracks(network, dataset, chosen.frames, **narrow, progress=report)
        lines += tracks_lines(result["tracks"])
    typer.echo(json.dumps(result, allow_nan=False) if as_json else "\n".join(lines))
