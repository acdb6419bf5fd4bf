"""State of a training: its optimiser AdamW, its checkpoints, and the settings that identify it.

The settings are all that determines the weights, except the kind of processor and the versions of libraries.
"""

import io
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adamw import adamw

from flcav.config import Config, DamagedFile, InputError
from flcav.interface.progress import DAMAGED
from flcav.perception.weights import Card, DataEntry, read_card
from flcav.storage.files import write_bytes

BETAS, EPSILON, WEIGHT_DECAY = (0.9, 0.99), 1e-8, 0.01


class AdamW:
    """AdamW with the moments of a network's parameters (Loshchilov and Hutter, ICLR 2019).

    Its steps equal those of `torch.optim.AdamW` to the bit, since they use PyTorch's functional implementation. That
    class would import PyTorch's compiler, which costs 1.7 s and 65 MB in every process that trains.
    """

    def __init__(self, network: nn.Module, learning_rate: float) -> None:
        """Start with moments of zero."""
        self.learning_rate = learning_rate
        self._parameters = [*network.parameters()]
        self._first = [torch.zeros_like(each) for each in self._parameters]  # moments of the gradient
        self._second = [torch.zeros_like(each) for each in self._parameters]
        self._steps = [torch.zeros((), device=each.device) for each in self._parameters]

    @torch.no_grad()
    def step(self) -> None:
        """Change the parameters that have a gradient, in place."""
        held = zip(self._parameters, self._first, self._second, self._steps, strict=True)
        updated = [(each, each.grad, *moments) for each, *moments in held if each.grad is not None]
        if updated:
            parameters, gradients, first, second, steps = map(list, zip(*updated, strict=True))
            rate: Any = {"lr": self.learning_rate, "beta1": BETAS[0], "beta2": BETAS[1], "eps": EPSILON}
            decay: Any = {"weight_decay": WEIGHT_DECAY, "amsgrad": False, "maximize": False}
            adamw(parameters, gradients, first, second, [], steps, fused=True, **rate, **decay)

    def state(self) -> dict[str, list[Tensor]]:
        """Return the moments and step counts, for a checkpoint; not copied."""
        return {"first": self._first, "second": self._second, "steps": self._steps}

    def to_arrays(self, names: Sequence[str]) -> dict[str, NDArray[np.number]]:
        """Return a copy of the state as arrays; `names` are the names of the parameters, in order."""
        held = self.state().items()
        return {
            f"{kind}/{name}": each.numpy(force=True).copy()
            for kind, tensors in held
            for name, each in zip(names, tensors)
        }

    def restore_arrays(self, arrays: Mapping[str, NDArray[np.number]], names: Sequence[str]) -> None:
        """Restore the state that `to_arrays` returned; raises `InputError` for that of another network."""
        wanted = [f"{kind}/{name}" for kind in self.state() for name in names]
        if lacking := {*wanted} ^ arrays.keys():
            raise InputError(f"state of an optimiser: '{min(lacking)}' is missing or unknown")
        tensors = {key: torch.from_numpy(np.array(arrays[key])) for key in wanted}
        try:
            self.restore({kind: [tensors[f"{kind}/{name}"] for name in names] for kind in self.state()})
        except ValueError as error:
            raise InputError(f"state of an optimiser: {error}") from None

    def restore(self, state: dict[str, list[Tensor]]) -> None:
        """Restore the moments and step counts of a checkpoint; raises ValueError for those of another network."""
        for name, held in self.state().items():
            for moment, saved in zip(held, state[name], strict=True):
                if moment.shape != saved.shape:
                    raise ValueError(f"{name}: {tuple(saved.shape)} instead of {tuple(moment.shape)}")
                moment.copy_(saved)


TRAINED = ("device", "epochs", "patience", "batch", "learning_rate", "schedule")  # settings in `Card.training`
DataIdentity = tuple[str, tuple[str, ...] | None]  # SHA-256 of a manifest, agents used (None in older cards)
NAMED = {"data": "other data or agents", "validation": "other validation data or agents"}


class TrainingSettings(Config):
    """Settings of a training, which determine its weights; None where an older card lacks them."""

    task: str
    network: str  # name of the configuration
    seed: int
    threads: int | None  # CPU threads
    device: str | None  # cpu | cuda
    data: tuple[DataIdentity, ...]
    validation: DataIdentity | None
    epochs: int
    patience: int | None  # None without validation data
    batch: int
    learning_rate: float
    schedule: str

    def differences(self, other: "TrainingSettings") -> str:
        """Return the differences of `other` in words; empty if there are none."""
        pairs = [(name, getattr(self, name), getattr(other, name)) for name in type(self).model_fields]
        return ", ".join(
            NAMED.get(name, f"{name} {theirs} instead of {ours}") for name, ours, theirs in pairs if ours != theirs
        )


def settings_of(card: Card) -> TrainingSettings:
    """Return the settings of the training described by a card."""
    return TrainingSettings.model_validate(
        {
            "task": card.task,
            "network": card.network,
            "seed": card.seed,
            "threads": card.threads,
            "data": tuple(map(part_of, card.data)),
            "validation": None if card.validation is None else part_of(card.validation),
            **{name: card.training.get(name) for name in TRAINED},
        }
    )


def part_of(entry: DataEntry) -> DataIdentity:
    """Return the identity of a dataset in a card: its manifest's SHA-256 and the agents used."""
    return entry.manifest, entry.agents


def find_finished_card(path: Path, asked: TrainingSettings) -> Card | None:
    """Return the card of the weights at `path`; None if there is no such file.

    Raises `InputError` if they were trained with other settings than `asked`, or are a mean of several trainings'
    weights, so that they are not overwritten.
    """
    if not path.exists():
        return None
    card = read_card(path)
    if "averaged" in card.training:
        raise InputError(f"{path}: a mean of the weights of several trainings; choose another folder")
    if different := asked.differences(settings_of(card)):
        anew = ", where it begins anew: the learning rate's schedule spans all epochs" if "epochs" in different else ""
        raise InputError(
            f"{path}: weights of a training with other settings ({different}); choose another folder{anew}"
        )
    return card


@dataclass
class RunState:
    """State of a training run: losses, validation scores and best weights so far."""

    losses: list[float] = field(default_factory=list)  # one per step
    scores: list[float] = field(default_factory=list)  # one per validation
    best: dict[str, Tensor] | None = None  # weights of the best validation; None before the first


def save_checkpoint(path: Path, identity: str, progress: RunState, network: nn.Module, optimizer: AdamW) -> None:
    """Write a checkpoint of the run `identity`, atomically: progress, network and optimiser."""
    state = {
        "identity": identity,
        "losses": torch.tensor(progress.losses, dtype=torch.float64),
        "scores": torch.tensor(progress.scores, dtype=torch.float64),
        "best": progress.best,
        "network": network.state_dict(),
        "optimizer": optimizer.state(),
    }
    data = io.BytesIO()
    torch.save(state, data)
    write_bytes(path, data.getvalue())


def load_checkpoint(path: Path, identity: str, network: nn.Module, optimizer: AdamW) -> RunState:
    """Restore network and optimiser in place and return the progress; without a file, an empty progress.

    Raises `DamagedFile` if the file is not a checkpoint, which may leave network and optimiser in any state, and
    `InputError` if it belongs to another run. No code in the file is executed.
    """
    if not path.exists():
        return RunState()
    broken = DamagedFile(f"{path} {DAMAGED}, training begins anew")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        saved = str(state["identity"])
        progress = RunState(state["losses"].tolist(), state["scores"].tolist(), state["best"])
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, AttributeError):
        raise broken from None
    if saved != identity:
        raise InputError(f"{path}: the checkpoint of a run with other settings or data; remove it to start afresh")
    try:
        network.load_state_dict(state["network"])
        optimizer.restore(state["optimizer"])
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError):
        raise broken from None
    return progress
