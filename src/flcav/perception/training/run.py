"""A complete training of any task: from datasets to a file of weights, its model card and TensorBoard event files."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import ConcatDataset

from flcav.arrays import Array
from flcav.config import DamagedFile
from flcav.dataset.store import Dataset
from flcav.interface.progress import DAMAGED, Report, ignore_progress
from flcav.machine.locks import only_writer
from flcav.perception.agents import FrameSelection, choose_frames
from flcav.perception.device import CPU, processor_of
from flcav.perception.task import Calibrates, Evaluated, Task, build_network, find_configuration
from flcav.perception.training.checkpoint import TrainingSettings, find_finished_card, part_of
from flcav.perception.training.loop import Checkpointing, Validation, Watch, train
from flcav.perception.weights import Card, DataEntry, data_entry, save_network, write_card
from flcav.storage.files import check_writable

WEIGHTS, CARD, CHECKPOINT, EVENTS = "weights.safetensors", "card.md", "checkpoint.pt", "events"


@contextlib.contextmanager
def event_files(folder: Path) -> Iterator[Watch]:
    """Yield a `Watch` that writes TensorBoard event files to `folder`, which is created with the first scalar.

    A resumed run hides the events that the interrupted run wrote after the checkpoint.
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


@dataclass(frozen=True)
class TrainingRequest:
    """Arguments of a training."""

    data: Sequence[Dataset]
    validation: Dataset | None = None  # with other scenes
    network: str | None = None  # name of the configuration; None: the task's default
    epochs: int = 10
    patience: int = 5  # epochs without a better validation score after which training stops
    seed: int = 0
    device: torch.device = CPU
    agents: str | None = None  # selection of frames, also for validation: see `flcav.perception.agents.choose_frames`


@dataclass(frozen=True)
class DatasetPart:
    """A dataset with the frames selected from it."""

    data: Dataset
    chosen: FrameSelection
    entry: DataEntry  # its entry in the card


@dataclass(frozen=True)
class Prepared:
    """A training whose arguments are checked and whose samples are listed."""

    task: Task
    request: TrainingRequest
    out: Path
    config: Any  # configuration of the network
    settings: TrainingSettings
    parts: tuple[DatasetPart, ...]  # training data
    held: DatasetPart | None  # validation data
    finished: Card | None  # card of the weights in `out`, if the training was finished before
    samples: Sequence[Any]  # training samples; empty if finished before

    def lines(self) -> list[str]:
        """Return the training and validation data in words, one line per dataset."""
        named = [*((part, "") for part in self.parts), *([(self.held, ", for validation")] if self.held else [])]
        return [f"{part.data.folder}: {part.chosen.sentence}{what}" for part, what in named]


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training: model card and evaluation."""

    card: Card  # of the weights
    evaluation: Evaluated | None = None  # on the validation data; None without, or if finished before


def train_network(task: Task, request: TrainingRequest, out: Path, progress: Report = ignore_progress) -> Card:
    """Train a network and write weights, card and curves to `out`; resume an interrupted run there. Return the card.

    The learning rate follows one schedule over all epochs. With validation data, the network of the best epoch is kept,
    its scores are calibrated if the task is `Calibrates`, and its evaluation goes into the card. If `out` holds weights
    of the same settings, nothing is trained. Raises as `prepare_training` does.
    """
    return train_prepared(prepare_training(task, request, out), progress).card


def prepare_training(task: Task, request: TrainingRequest, out: Path) -> Prepared:
    """Check the arguments of a training and list its samples.

    Raises `InputError` for an unknown network, for data or agents that the task cannot use, and if `out` holds weights
    of other settings; `OSError`, before any data are read, if `out` cannot be written.
    """
    check_writable(out)
    config = find_configuration(task, request.network)
    parts = tuple(_part(task, config, data, request.agents) for data in request.data)
    held = None if request.validation is None else _part(task, config, request.validation, request.agents)
    settings = TrainingSettings(
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
    finished = _find_finished(out, settings)
    samples: Any = ()
    if finished is None:
        labelled = [task.samples(part.data, config, part.chosen.frames) for part in parts]
        samples = ConcatDataset(labelled)  # pyright: ignore[reportArgumentType]
        if held is not None:
            task.samples(held.data, config, held.chosen.frames)  # raises for bad validation data before the long work
    return Prepared(task, request, out, config, settings, parts, held, finished, samples)


def train_prepared(prepared: Prepared, progress: Report = ignore_progress) -> TrainingResult:
    """Perform a training prepared by `prepare_training`, see `train_network`; return its card and evaluation."""
    with only_writer(prepared.out):
        return _train(prepared, progress)


def _train(prepared: Prepared, progress: Report) -> TrainingResult:
    if (finished := _find_finished(prepared.out, prepared.settings)) is not None:
        if not (prepared.out / CARD).exists():
            write_card(finished, prepared.out / CARD)
        return TrainingResult(finished)
    if (weights := prepared.out / WEIGHTS).exists():
        progress(0, 1, f"{weights} {DAMAGED}, made anew")
    task, request, out, held = prepared.task, prepared.request, prepared.out, prepared.held
    settings = prepared.settings
    samples = prepared.samples
    network = build_network(task, prepared.config, request.seed).to(request.device)
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
    requested = settings.model_dump(include={*vars(task.practice), "epochs", "patience", "device"}, exclude_none=True)
    reached = {"loss": float(history.losses[-per_epoch:].mean()), "scores": _rounded(history.scores)}
    card = Card(
        task=task.name,
        network=settings.network,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        seed=request.seed,
        samples=len(samples),
        training=requested | {"steps": len(history.losses)} | reached,
        data=tuple(part.entry for part in prepared.parts),
        validation=None if held is None else held.entry,
        metrics={} if evaluation is None else evaluation.as_json(),
        torch=str(torch.__version__),
        threads=settings.threads,
        processor=processor_of(request.device),
    )
    save_network(task, network, out / WEIGHTS, card)
    write_card(card, out / CARD)
    return TrainingResult(card, evaluation)


def _find_finished(out: Path, settings: TrainingSettings) -> Card | None:
    """Return `find_finished_card` of the weights in `out`; None for damaged ones if a checkpoint can replace them."""
    try:
        return find_finished_card(out / WEIGHTS, settings)
    except DamagedFile:
        if (out / CHECKPOINT).exists():
            return None
        raise


def _part(task: Task, config: Any, data: Dataset, agents: str | None) -> DatasetPart:
    chosen = choose_frames(task, config, data, agents)
    return DatasetPart(data, chosen, data_entry(data, chosen))


def _rounded(scores: Array) -> list[float]:
    return [round(float(score), 4) for score in scores]


def _validation(prepared: Prepared, per_epoch: int) -> Validation | None:
    held = prepared.held
    task = prepared.task
    if held is None:
        return None

    def score(network: nn.Module) -> float:
        return task.evaluate(network, held.data, held.chosen.frames).score

    return Validation(score, per_epoch, prepared.request.patience)
