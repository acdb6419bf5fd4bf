"""flcav train: a dataset to a network."""

from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    task: str = typer.Argument(help="What to learn: objects."),
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(..., "--out", help="Folder of the weights; an interrupted training goes on."),
    network: str = typer.Option("tiny", "--network", help="tiny or paper."),
    epochs: int = typer.Option(10, "--epochs", min=1, help="Passes through the data."),
    seed: int = typer.Option(0, "--seed", help="Initial weights, order and augmentation."),
) -> None:
    """Train a network on recorded frames with their ground truth; writes OUT/weights.safetensors."""
    from flcav import progress
    from flcav.cli.tasks import DatasetSamples, task_named
    from flcav.dataset.store import Dataset
    from flcav.files import write_json

    learner = task_named(task)
    net = learner.network(network, seed)
    samples = DatasetSamples([Dataset.open(folder) for folder in data], learner, net)
    with progress.live(f"train {task}") as report:
        loss = learner.train(net, samples, epochs=epochs, seed=seed, checkpoint=out / "checkpoint.pt", progress=report)
    weights = out / "weights.safetensors"
    learner.save(net, weights)
    settings = {"task": task, "network": network, "epochs": epochs, "seed": seed, "data": [str(path) for path in data]}
    write_json(out / "training.json", settings | {"samples": len(samples), "loss": loss})
    typer.echo(f"{weights}: trained on {len(samples)} samples, {epochs} epochs, mean loss of the last {loss:.3f}")
