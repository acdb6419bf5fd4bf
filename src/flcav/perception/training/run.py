"""A training from datasets to a file of weights, its card and TensorBoard's events."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.utils.data import ConcatDataset

from flcav.dataset.store import Dataset
from flcav.files import check_writable
from flcav.perception.agents import Chosen, choose_frames
from flcav.perception.card import Card, DataEntry, data_entry, write_card
from flcav.perception.device import CPU, processor_of
from flcav.perception.task import Calibrates, Evaluated, Task, configuration, fresh
from flcav.perception.training.checkpoint import Settings, finished_card, part_of
from flcav.perception.training.loop import Checkpointing, Validation, Watch, train
from flcav.perception.weights import save_network
from flcav.progress import Report, silent


@contextlib.contextmanager
def event_files(folder: Path) -> Iterator[Watch]:
    """Yield a `Watch` that writes scalars below `folder`, which is made with the first one.

    A run that goes on from a checkpoint hides what an interrupted one wrote after it.
    """
    writer: Any = None

    def watch(step: int, values: Mapping[str, float]) -> None:
        nonlocal writer
        if writer is None:
            from torch.utils.tensorboard import SummaryWriter

            writer = SummaryWriter(folder, purge_step=step)
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    try:
        yield watch
    finally:
        if writer is not None:
            writer.close()


WEIGHTS, CARD, CHECKPOINT, EVENTS = "weights.safetensors", "card.md", "checkpoint.pt", "events"


@dataclass(frozen=True)
class Request:
    """What is to be trained on what."""

    data: Sequence[Dataset]
    validation: Dataset | None = None  # of other scenes
    network: str | None = None  # name of the configuration; None: the task's default
    epochs: int = 10
    patience: int = 5  # epochs without a better validation after which training ends
    seed: int = 0
    device: torch.device = CPU
    agents: str | None = None  # whose frames, of validation too: see `flcav.perception.agents`


@dataclass(frozen=True)
class Part:
    """A dataset and the frames of it that are used."""

    data: Dataset
    chosen: Chosen
    entry: DataEntry  # in the card


@dataclass(frozen=True)
class Prepared:
    """A training that can begin, or has been finished before."""

    task: Task
    request: Request
    out: Path
    config: Any  # the network's
    settings: Settings
    parts: tuple[Part, ...]
    held: Part | None  # for validation
    finished: Card | None  # of the weights that lie in `out` already
    samples: Sequence[Any]  # none where it is finished

    def lines(self) -> list[str]:
        """Return what is learned from, and what is validated on, in words."""
        named = [*((part, "") for part in self.parts), *([(self.held, ", for validation")] if self.held else [])]
        return [f"{part.data.folder}: {part.chosen.sentence}{what}" for part, what in named]


@dataclass(frozen=True)
class Trained:
    """What a training came to."""

    card: Card  # of the weights
    evaluation: Evaluated | None = None  # on the validation data; None where there are none, or it was trained before


def train_network(task: Task, request: Request, out: Path, progress: Report = silent) -> Card:
    """Train, going on from where an interrupted run left off in `out`; write weights, card and curves there.

    One learning-rate cycle over all epochs. With validation data, the network of the best epoch is kept, its scores are
    calibrated where the task does so, and its evaluation is in the card. Where `out` holds the weights of these very
    settings, nothing is done. Raises as `prepare` does.
    """
    return train_prepared(prepare(task, request, out), progress).card


def prepare(task: Task, request: Request, out: Path) -> Prepared:
    """Return the training that is asked for, its samples found.

    Raises `InputError` for an unknown network, for data or agents that the task cannot use and where `out` holds the
    weights of other settings; `OSError` before anything is read where `out` cannot be written.
    """
    check_writable(out)
    config = configuration(task, request.network)
    parts = tuple(_part(task, config, data, request.agents) for data in request.data)
    held = None if request.validation is None else _part(task, config, request.validation, request.agents)
    settings = Settings(
        task=task.name,
        network=request.network or next(iter(task.configurations)),
        seed=request.seed,
        threads=torch.get_num_threads(),
        device=request.device.type,
        data=tuple(part_of(part.entry) for part in parts),
        validation=held and part_of(held.entry),
        epochs=request.epochs,
        patience=request.patience if held else None,
        **vars(task.practice),
    )
    finished = finished_card(out / WEIGHTS, settings)
    samples: Any = ()
    if finished is None:
        found = [task.samples(part.data, config, part.chosen.frames) for part in parts]
        samples = ConcatDataset(found)  # pyright: ignore[reportArgumentType]
        if held is not None:
            task.samples(held.data, config, held.chosen.frames)  # what is wrong is said before the long work
    return Prepared(task, request, out, config, settings, parts, held, finished, samples)


def train_prepared(prepared: Prepared, progress: Report = silent) -> Trained:
    """Train what `prepare` returned, see `train_network`."""
    if prepared.finished is not None:
        return Trained(prepared.finished)
    task, request, out, held = prepared.task, prepared.request, prepared.out, prepared.held
    settings, samples = prepared.settings, prepared.samples
    network = fresh(task, prepared.config, request.seed).to(request.device)
    per_epoch = max(1, len(samples) // task.practice.batch)
    with event_files(out / EVENTS) as watch:
        history = train(
            task,
            network,
            samples,
            steps=request.epochs * per_epoch,
            seed=request.seed,
            checkpointing=Checkpointing(out / CHECKPOINT, of=settings.model_dump_json()),
            validation=_validation(prepared, per_epoch),
            watch=watch,
            progress=progress,
        )
    if held is not None and isinstance(task, Calibrates):
        task.calibrate(network, held.data, held.chosen.frames)
    evaluation = None if held is None else task.evaluate(network, held.data, held.chosen.frames)
    asked = settings.model_dump(include={*vars(task.practice), "epochs", "patience", "device"}, exclude_none=True)
    reached = {"loss": float(history.losses[-per_epoch:].mean()), "scores": _rounded(history.scores)}
    card = Card(
        task=task.name,
        network=settings.network,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        seed=request.seed,
        samples=len(samples),
        training=asked | {"steps": len(history.losses)} | reached,
        data=tuple(part.entry for part in prepared.parts),
        validation=None if held is None else held.entry,
        metrics={} if evaluation is None else evaluation.as_json(),
        torch=str(torch.__version__),
        threads=settings.threads,
        processor=processor_of(request.device),
    )
    save_network(task, network, out / WEIGHTS, card)
    write_card(card, out / CARD)
    return Trained(card, evaluation)


def _part(task: Task, config: Any, data: Dataset, agents: str | None) -> Part:
    chosen = choose_frames(task, config, data, agents)
    return Part(data, chosen, data_entry(data, chosen))


def _rounded(scores: NDArray[np.float64]) -> list[float]:
    return [round(float(score), 4) for score in scores]


def _validation(prepared: Prepared, per_epoch: int) -> Validation | None:
    held, task = prepared.held, prepared.task
    if held is None:
        return None

    def score(network: nn.Module) -> float:
        return task.evaluate(network, held.data, held.chosen.frames).score

    return Validation(score, per_epoch, prepared.request.patience)
