"""Weights on disk and as arrays: safetensors files that say which network they are of."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from flcav.config import InputError
from flcav.files import write_bytes
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second, second

CONFIG_KEY = "flcav.second"  # metadata entry that holds the network's configuration as JSON
_CONFIG = TypeAdapter(SecondConfig)


def save_network(network: Second, path: Path) -> None:
    """Write the network's configuration and weights to a safetensors file, atomically."""
    tensors = {name: tensor.contiguous().cpu() for name, tensor in network.state_dict().items()}
    metadata = {CONFIG_KEY: _CONFIG.dump_json(network.config).decode()}
    write_bytes(path, save(tensors, metadata))


def load_network(path: Path) -> Second:
    """Return the network that `save_network` wrote, in evaluation mode; raises `InputError` for any other file."""
    config, tensors = _read(path)
    with torch.random.fork_rng(devices=[]):
        network = second(config)
    _fill(network, tensors, path)
    return network.eval()


def load_weights(network: Second, path: Path) -> None:
    """Load the weights at `path` into `network`; raises `InputError` where they are of another one."""
    config, tensors = _read(path)
    if config != network.config:
        raise InputError(f"{path}: weights of another network ({_difference(config, network.config)})")
    _fill(network, tensors, path)


def to_arrays(network: Second) -> dict[str, NDArray[Any]]:
    """Return copies of parameters and buffers by name."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def from_arrays(network: Second, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Set parameters and buffers from what `to_arrays` returned; raises `InputError` where they do not fit."""
    state = network.state_dict()
    if set(arrays) != set(state):
        odd = sorted(set(arrays) ^ set(state))
        raise InputError(f"weights of another network: {len(odd)} arrays missing or unknown, the first is '{odd[0]}'")
    for name, array in arrays.items():
        if array.shape != tuple(state[name].shape):
            raise InputError(
                f"weights of another network: '{name}' has shape {array.shape}, not {tuple(state[name].shape)}"
            )
        state[name].copy_(torch.from_numpy(np.ascontiguousarray(array)))


def _read(path: Path) -> tuple[SecondConfig, dict[str, torch.Tensor]]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError):
        raise InputError(f"{path}: not a safetensors file, or a damaged one") from None
    if CONFIG_KEY not in metadata:
        raise InputError(f"{path}: weights of another network (no '{CONFIG_KEY}' in the file's metadata)")
    try:
        return _CONFIG.validate_json(metadata[CONFIG_KEY]), tensors
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: weights of another network (field '{field}': {first['msg']})") from None


def _fill(network: Second, tensors: dict[str, torch.Tensor], path: Path) -> None:
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: weights of another network ({reason})") from None


def _difference(theirs: SecondConfig, ours: SecondConfig) -> str:
    names = [name for name in vars(ours) if not name.startswith("_") and getattr(theirs, name) != getattr(ours, name)]
    return ", ".join(f"{name} {getattr(theirs, name)} instead of {getattr(ours, name)}" for name in names)[:300]
