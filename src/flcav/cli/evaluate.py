"""flcav evaluate: how good a network is on a dataset."""

import json
from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


def evaluate(
    task: str = typer.Argument(help="What was learned: objects."),
    data: Path = typer.Option(..., "--data", help="Dataset folder."),
    weights: Path | None = typer.Option(None, "--weights", help="Weights (safetensors) that flcav train wrote."),
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Evaluate a network on recorded frames: average precision with its 95 % interval over scenes."""
    from flcav import progress
    from flcav.cli.tasks import task_named, weights_given
    from flcav.dataset.store import Dataset

    learner = task_named(task)
    network = learner.load(weights_given(weights, task))
    dataset = Dataset.open(data)
    frames = (dataset.frame(i) for i in range(len(dataset)))
    with progress.live(f"evaluate {task}") as report:
        result = learner.evaluate(network, frames, total=len(dataset), progress=report)
    if as_json:
        typer.echo(json.dumps(result, allow_nan=False))
        return
    typer.echo(f"{result['frames']} frames of {result['scenes']} scenes")
    for row in result["scores"]:
        ap = "nothing to find" if row["ap"] is None else f"AP {row['ap']:.3f} [{row['low']:.3f}, {row['high']:.3f}]"
        counts = f"{row['targets']} objects, {row['hidden']} more without a return"
        typer.echo(f"{row['class']:<12}{row['kind']:>4} IoU {row['iou']:.1f}  {ap}  ({counts})")
