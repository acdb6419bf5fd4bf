"""flcav train: a dataset to a network."""

from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    task: str = typer.Argument(help="What to learn: weather, signs, objects or trajectory."),
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(..., "--out", help="Folder of the weights; an interrupted training goes on."),
    validation: Path | None = typer.Option(
        None,
        "--validation",
        help="Dataset of other scenes: keeps the epoch that is best on it, may stop early, calibrates scores.",
    ),
    network: str | None = typer.Option(
        None,
        "--network",
        help="tiny (default) or paper; objects also small; signs n (default) or s; trajectory also tiny-cameras, "
        "paper-cameras.",
    ),
    epochs: int = typer.Option(10, "--epochs", min=1, help="Passes through the data."),
    patience: int = typer.Option(5, "--patience", min=1, help="Epochs without a better validation before it stops."),
    seed: int = typer.Option(0, "--seed", min=0, help="Initial weights, order and augmentation."),
    device: str = typer.Option("auto", "--device", help="cpu, cuda, or auto: a GPU where there is one."),
) -> None:
    """Train a network on recorded frames with their ground truth; writes OUT/weights.safetensors and its card.

    Curves for TensorBoard go to OUT/events.
    """
    from flcav import progress
    from flcav.cli.refusals import refuse_unused
    from flcav.cli.tasks import task_named
    from flcav.dataset.store import Dataset
    from flcav.perception.device import device_named
    from flcav.perception.training.run import Request, train_network

    if validation is None:
        refuse_unused("a training without --validation", "patience")
    learner, place = task_named(task), device_named(device)
    held = Dataset.open(validation) if validation else None
    request = Request([Dataset.open(folder) for folder in data], held, network, epochs, patience, seed, place)
    with progress.live(f"train {task}") as report:
        card = train_network(learner, request, out, report)
    told = f"{out / 'weights.safetensors'}: trained on {card.samples} samples, {card.training['steps']} steps"
    typer.echo(f"{told}, mean loss of the last epoch {card.training['loss']:.3f}")
    if card.metrics:
        typer.echo("\n".join(["on the validation data:", *learner.evaluation_lines(card.metrics)]))
