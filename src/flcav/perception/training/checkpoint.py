"""Checkpoints of a training run, and the settings that identify it.

The settings are all that decides the weights, except the kind of processor and the versions of libraries.
"""

import io
import pickle
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from flcav.config import Config, DamagedFile, InputError
from flcav.interface.progress import DAMAGED
from flcav.perception.card import Card, DataEntry
from flcav.perception.training.adamw import AdamW
from flcav.perception.weights import read_card
from flcav.storage.files import write_bytes

TRAINED = ("device", "epochs", "patience", "batch", "learning_rate", "schedule")  # settings in `Card.training`
DataIdentity = tuple[
    str, tuple[str, ...] | None
]  # a dataset: SHA-256 of its manifest, agents used (None in older cards)
NAMED = {"data": "other data or agents", "validation": "other validation data or agents"}


class Settings(Config):
    """Settings of a training, which decide its weights; None where an older card lacks them."""

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

    def differences(self, other: "Settings") -> str:
        """Return the differences of `other` in words; an empty string if there are none."""
        pairs = [(name, getattr(self, name), getattr(other, name)) for name in type(self).model_fields]
        return ", ".join(
            NAMED.get(name, f"{name} {theirs} instead of {own}") for name, own, theirs in pairs if own != theirs
        )


def settings_of(card: Card) -> Settings:
    """Return the settings of the training that a card describes."""
    return Settings.model_validate(
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


def find_finished_card(path: Path, asked: Settings) -> Card | None:
    """Return the card of the weights at `path`; None if there is no such file.

    Raises `InputError` if they were trained with other settings than `asked`, so that they are not overwritten.
    """
    if not path.exists():
        return None
    card = read_card(path)
    if different := asked.differences(settings_of(card)):
        raise InputError(f"{path}: weights of a training with other settings ({different}); choose another folder")
    return card


@dataclass
class RunState:
    """State of a training run: losses, validation scores and best weights so far."""

    losses: list[float] = field(default_factory=list)  # of each step
    scores: list[float] = field(default_factory=list)  # of each validation
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

    Raises `DamagedFile` if the file is not a checkpoint, network and optimiser may be any then, and `InputError` if it
    is one of another run. No code in the file is executed.
    """
    if not path.exists():
        return RunState()
    broken = DamagedFile(f"{path} {DAMAGED}, training begins anew")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        found = str(state["identity"])
        progress = RunState(state["losses"].tolist(), state["scores"].tolist(), state["best"])
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, AttributeError):
        raise broken from None
    if found != identity:
        raise InputError(f"{path}: the checkpoint of a run with other settings or data; remove it to start afresh")
    try:
        network.load_state_dict(state["network"])
        optimizer.restore(state["optimizer"])
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError):
        raise broken from None
    return progress
