"""`flcav train`: train a network on datasets."""

from pathlib import Path

import typer

from flcav.cli.options import AGENTS, ANY_TASK, THREADS, Device
from flcav.cli.terminal import echo, when_interrupted
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    task: str = typer.Argument(metavar="TASK", help=f"What to learn: {ANY_TASK}."),
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(
        ..., "--out", help="Folder of the weights; an interrupted training goes on, a finished one is left alone."
    ),
    validation: Path | None = typer.Option(
        None,
        "--validation",
        help="Dataset of other scenes: keeps the epoch that is best on it, may stop early, calibrates scores.",
    ),
    network: str | None = typer.Option(
        None,
        "--network",
        help="Which of the task's networks: docs/tasks.md names them; by default its first.",
    ),
    epochs: int = typer.Option(10, "--epochs", min=1, help="Passes through the data."),
    patience: int = typer.Option(5, "--patience", min=1, help="Epochs without a better validation before it stops."),
    seed: int = typer.Option(0, "--seed", min=0, help="Initial weights, order and augmentation."),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    agents: str | None = AGENTS,
    threads: int = THREADS,
) -> None:
    """Train a network on recorded frames with their ground truth; writes OUT/weights.safetensors and its card.

    Curves for TensorBoard go to OUT/events.
    """
    use_threads(threads)
    from flcav.cli.options import refuse_unused
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.perception.device import select_device
    from flcav.perception.tasks import task_named
    from flcav.perception.training.run import CHECKPOINT, WEIGHTS, TrainingRequest, prepare_training, train_prepared

    if validation is None:
        refuse_unused("a training without --validation", "patience")
    learner, place = task_named(task), select_device(device)
    held = Dataset.open(validation) if validation else None
    request = TrainingRequest(
        [Dataset.open(folder) for folder in data], held, network, epochs, patience, seed, place, agents
    )

    def kept() -> str:
        saved = out / CHECKPOINT
        return f"the same command goes on from {saved}" if saved.exists() else "nothing saved yet"

    with when_interrupted(kept):
        prepared = prepare_training(learner, request, out)
        if prepared.finished is not None:
            train_prepared(prepared)  # its card may be missing
            echo(f"{out / WEIGHTS}: trained with these settings before, nothing to do")
            return
        echo("\n".join(prepared.lines()))
        with progress.show_progress(f"train {task}") as report:
            trained = train_prepared(prepared, report)
    card = trained.card
    told = f"{out / WEIGHTS}: trained on {plural(card.samples, 'sample')}, {plural(card.learning.steps, 'step')}"
    echo(f"{told}, mean loss of the last epoch {card.learning.loss:.3f}")
    if trained.evaluation is not None:
        echo("\n".join(["on the validation data:", *trained.evaluation.lines()]))
