"""Where a training run left off."""

import io
import pickle
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from flcav.config import InputError
from flcav.files import write_bytes


def save_checkpoint(
    path: Path,
    identity: str,
    steps: int,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    losses: NDArray[np.float64],
) -> None:
    """Write the state after `steps` steps of the run that `identity` describes, atomically."""
    state = {
        "identity": identity,
        "steps": steps,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "losses": torch.from_numpy(losses),
    }
    data = io.BytesIO()
    torch.save(state, data)
    write_bytes(path, data.getvalue())


def load_checkpoint(
    path: Path, identity: str, network: nn.Module, optimizer: torch.optim.Optimizer, losses: NDArray[np.float64]
) -> int:
    """Restore network, optimiser and losses in place and return the steps done; 0 where there is no file.

    Raises `InputError` where the file is not a checkpoint or one of another run. Nothing in it is executed.
    """
    if not path.exists():
        return 0
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        found, steps = str(state["identity"]), int(state["steps"])
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: not a checkpoint; remove it to start afresh") from None
    if found != identity:
        raise InputError(f"{path}: the checkpoint of a run with other settings or data; remove it to start afresh")
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    losses[:] = state["losses"].numpy()
    return steps
