"""flcav evaluate: how good a network is on a dataset."""

import json
from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


def evaluate(
    task: str = typer.Argument(help="What was learned: weather, signs or objects."),
    data: Path = typer.Option(..., "--data", help="Dataset folder."),
    weights: Path | None = typer.Option(None, "--weights", help="Weights (safetensors) that flcav train wrote."),
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Evaluate a network on recorded frames: accuracy of weather, mAP of signs, average precision of objects."""
    from flcav import progress
    from flcav.cli.tasks import task_named, weights_given
    from flcav.dataset.store import Dataset
    from flcav.perception.weights import load_network

    learner = task_named(task)
    network = load_network(learner, weights_given(weights, task))
    with progress.live(f"evaluate {task}") as report:
        result = learner.evaluate(network, Dataset.open(data), progress=report)
    lines = [json.dumps(result, allow_nan=False)] if as_json else learner.evaluation_lines(result)
    typer.echo("\n".join(lines))
