"""flcav evaluate: how good a network is on a dataset."""

import json
from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


def evaluate(
    task: str = typer.Argument(help="What was learned: weather, signs, objects or trajectory."),
    data: Path = typer.Option(..., "--data", help="Dataset folder."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Evaluate a network on recorded frames.

    Accuracy of weather, mAP of signs, average precision of objects, errors of predicted paths.
    """
    from flcav import progress
    from flcav.cli.tasks import network_of, task_named
    from flcav.dataset.store import Dataset

    learner = task_named(task)
    network = network_of(learner, weights)
    with progress.live(f"evaluate {task}") as report:
        result = learner.evaluate(network, Dataset.open(data), progress=report)
    lines = [json.dumps(result, allow_nan=False)] if as_json else learner.evaluation_lines(result)
    typer.echo("\n".join(lines))
