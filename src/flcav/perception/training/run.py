"""A whole training of any task, from datasets to a file of weights with its card."""

from collections.abc import Sequence
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
from flcav.perception.card import Card, data_entry, write_card
from flcav.perception.device import CPU
from flcav.perception.task import Calibrates, Task, configuration, fresh
from flcav.perception.training.events import event_files
from flcav.perception.training.loop import Checkpointing, Validation, train
from flcav.perception.weights import save_network
from flcav.progress import Report, silent

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


def train_network(task: Task[Any, Any, Any], request: Request, out: Path, progress: Report = silent) -> Card:
    """Train, going on from where an interrupted run left off in `out`; write weights, card and curves there.

    One learning-rate cycle over all epochs. With validation data, the network of the best epoch is kept, its scores are
    calibrated where the task does so, and its evaluation is in the card. Raises `InputError` for an unknown network and
    for data that the task cannot use, `OSError` before anything is read where `out` cannot be written.
    """
    check_writable(out)
    config = configuration(task, request.network)
    network = fresh(task, config, request.seed).to(request.device)
    parts = [task.samples(data, config) for data in request.data]
    samples: Any = ConcatDataset(parts)  # pyright: ignore[reportArgumentType]
    if request.validation is not None:
        task.samples(request.validation, config)  # what is wrong with them is said before the long work
    per_epoch = max(1, len(samples) // task.practice.batch)
    with event_files(out / EVENTS) as watch:
        history = train(
            task,
            network,
            samples,
            steps=request.epochs * per_epoch,
            seed=request.seed,
            checkpointing=Checkpointing(out / CHECKPOINT),
            validation=_validation(task, request, per_epoch),
            watch=watch,
            progress=progress,
        )
    if request.validation is not None and isinstance(task, Calibrates):
        task.calibrate(network, request.validation)
    settings = vars(task.practice) | {"epochs": request.epochs, "steps": len(history.losses)}
    card = Card(
        task=task.name,
        network=request.network or next(iter(task.configurations)),
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        seed=request.seed,
        samples=len(samples),
        training=settings | {"loss": float(history.losses[-per_epoch:].mean()), "scores": _rounded(history.scores)},
        data=tuple(data_entry(data) for data in request.data),
        validation=data_entry(request.validation) if request.validation else None,
        metrics=task.evaluate(network, request.validation) if request.validation else {},
    )
    save_network(task, network, out / WEIGHTS, card)
    write_card(card, out / CARD)
    return card


def _rounded(scores: NDArray[np.float64]) -> list[float]:
    return [round(float(score), 4) for score in scores]


def _validation(task: Task[Any, Any, Any], request: Request, per_epoch: int) -> Validation | None:
    held = request.validation
    if held is None:
        return None

    def score(network: nn.Module) -> float:
        return task.score(task.evaluate(network, held))

    return Validation(score, per_epoch, request.patience)
