"""Where a training run left off."""

import io
import pickle
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from flcav.config import InputError
from flcav.files import write_bytes


@dataclass
class Progress:
    """What a run has behind it."""

    losses: list[float] = field(default_factory=list)  # of each step taken
    scores: list[float] = field(default_factory=list)  # of each validation
    best: dict[str, Tensor] | None = None  # the weights of the best validation


def save_checkpoint(
    path: Path, identity: str, progress: Progress, network: nn.Module, optimizer: torch.optim.Optimizer
) -> None:
    """Write the state of the run that `identity` describes, atomically."""
    state = {
        "identity": identity,
        "losses": torch.tensor(progress.losses, dtype=torch.float64),
        "scores": torch.tensor(progress.scores, dtype=torch.float64),
        "best": progress.best,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
    }
    data = io.BytesIO()
    torch.save(state, data)
    write_bytes(path, data.getvalue())


def load_checkpoint(path: Path, identity: str, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Restore network and optimiser in place and return what was done; nothing where there is no file.

    Raises `InputError` where the file is not a checkpoint or one of another run. Nothing in it is executed.
    """
    if not path.exists():
        return Progress()
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        found = str(state["identity"])
        progress = Progress(state["losses"].tolist(), state["scores"].tolist(), state["best"])
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: not a checkpoint; remove it to start afresh") from None
    if found != identity:
        raise InputError(f"{path}: the checkpoint of a run with other settings or data; remove it to start afresh")
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    return progress
