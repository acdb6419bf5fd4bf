"""Weights of networks as safetensors files, with configuration and model card as metadata, and as NumPy arrays."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from flcav.config import DamagedFile, InputError, check_is_file
from flcav.perception.card import CARD_KEY, Card
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.storage.files import write_bytes

PREFIX = "flcav."
LARGEST = 1e9  # largest absolute value of a weight; larger ones overflow in a few layers
SHIPPED = "shipped/weights.safetensors"  # relative to the folder of a task's module
KINDS = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64)  # of numbers in a file
COUNTER = "num_batches_tracked"  # buffer of batch normalisation, unused with a fixed momentum


def find_shipped(task: Task, name: str = SHIPPED) -> Path:
    """Return the path of the task's weights in the package; raises `InputError` if there are none.

    name: of another network of the package, relative to the folder of the task's module.
    """
    module = sys.modules.get(type(task).__module__)
    path = Path(getattr(module, "__file__", None) or "").parent / name
    if not path.is_file():
        raise InputError(f"--weights is missing: no weights of '{task.family}' come with the package, train some first")
    return path


def config_key(task: Task) -> str:
    """Return the metadata key of the network's configuration."""
    return PREFIX + task.family


def save_network(
    task: Task[ConfigT, NetworkT, SampleT], network: NetworkT, path: Path, card: Card | None = None
) -> None:
    """Write weights, configuration (JSON) and card (JSON) of a network to a safetensors file, atomically.

    The same network gives the same bytes.

    Args:
        task: the task, by whose name the file is recognised.
        network: the network.
        path: the file.
        card: data, settings and metrics of its training; None: unknown.
    """
    tensors = {name: tensor.contiguous().cpu() for name, tensor in network.state_dict().items()}
    metadata = {config_key(task): _adapter(task).dump_json(network.config).decode()}
    if card is not None:
        metadata[CARD_KEY] = card.model_dump_json()
    write_bytes(path, _in_order(save(tensors, metadata)))


def load_network(task: Task[ConfigT, NetworkT, SampleT], path: Path | str) -> NetworkT:
    """Return the network that `save_network` wrote, in evaluation mode on the CPU.

    Raises `InputError` for any other file, for weights that are not finite, and for the name of a task.
    """
    if isinstance(task, str):
        raise InputError(f"load_network: a task is wanted, flcav.task_named({task!r}), not its name")
    path = Path(path)
    config, tensors = _read(task, path)
    try:
        with torch.random.fork_rng(devices=[]):
            network = task.build(config)
    except (ValueError, TypeError, ArithmeticError, RuntimeError, AssertionError, MemoryError) as error:
        raise InputError(f"{path}: weights of an impossible network ({error})") from None
    _fill(network, tensors, path)
    return network.eval()


def read_card(path: Path | str) -> Card:
    """Return the card in a file of weights; raises `InputError` if there is none, `DamagedFile` if it is damaged."""
    metadata, _ = _opened(Path(path))
    if CARD_KEY not in metadata:
        raise InputError(f"{path}: weights without a card")
    try:
        return Card.model_validate_json(metadata[CARD_KEY])
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise DamagedFile(f"{path}: weights with a damaged card ({f'{field}: ' * bool(field)}{first['msg']})") from None


def to_arrays(network: nn.Module) -> dict[str, NDArray[np.number]]:
    """Return copies of parameters and buffers by name, except batch normalisation's `num_batches_tracked`."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in _learned(network).items()}


def from_arrays(network: nn.Module, arrays: Mapping[str, NDArray[np.number]]) -> None:
    """Set parameters and buffers of `network` to the arrays of `to_arrays`.

    Raises `InputError` if names or shapes differ.
    """
    state = _learned(network)
    if set(arrays) != set(state):
        odd = sorted(set(arrays) ^ set(state))
        raise InputError(f"weights of another network: {len(odd)} arrays missing or unknown, the first is '{odd[0]}'")
    for name, array in arrays.items():
        if array.shape != tuple(state[name].shape):
            raise InputError(
                f"weights of another network: '{name}' has shape {array.shape}, not {tuple(state[name].shape)}"
            )
        state[name].copy_(torch.from_numpy(np.ascontiguousarray(array)))


def _in_order(data: bytes) -> bytes:
    """Return the bytes of a safetensors file with its metadata sorted by key, since the library's order varies."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


def _learned(network: nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor for name, tensor in network.state_dict().items() if not name.endswith(COUNTER)}


def _adapter(task: Task) -> TypeAdapter[Any]:
    return TypeAdapter(type(next(iter(task.configurations.values()))))


def _opened(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    check_is_file(path, None)  # what it holds is mapped
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            return file.metadata() or {}, tensors
    except (SafetensorError, OSError):
        raise DamagedFile(f"{path}: not a safetensors file, or a damaged one") from None


def _read(task: Task[ConfigT, NetworkT, SampleT], path: Path) -> tuple[ConfigT, dict[str, torch.Tensor]]:
    metadata, tensors = _opened(path)
    key = config_key(task)
    if key not in metadata:
        found = [name.removeprefix(PREFIX) for name in metadata if name.startswith(PREFIX) and name != CARD_KEY]
        said = f"of '{found[0]}'" if found else f"no '{key}' in the file's metadata"
        raise InputError(f"{path}: weights of another network ({said}); '{task.name}' takes those of '{task.family}'")
    try:
        return _adapter(task).validate_json(metadata[key]), tensors
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: weights of another network (field '{field}': {first['msg']})") from None


def _fill(network: nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    if odd := [name for name, tensor in tensors.items() if tensor.dtype not in KINDS]:
        raise InputError(f"{path}: weights of numbers that are not used here, in '{odd[0]}': {tensors[odd[0]].dtype}")
    if odd := [name for name, tensor in tensors.items() if not (tensor.abs() <= LARGEST).all()]:
        raise InputError(f"{path}: weights that are not finite numbers, in '{odd[0]}', or above {LARGEST:g}")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        reason = str(error)[:200]
        raise InputError(f"{path}: weights of another network ({reason})") from None
