"""Weights of networks as safetensors files, with configuration and model card as metadata, and as NumPy arrays.

A model card says how a network was trained and evaluated (Mitchell et al., "Model Cards for Model Reporting", 2019).
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from flcav.config import Config, DamagedFile, InputError, Json, check_is_file
from flcav.dataset.ground import POLE
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.interface.wording import plural
from flcav.perception.agents import FrameSelection, kind_of
from flcav.perception.task import ConfigT, KnownLidar, NetworkT, SampleT, Task
from flcav.sensors.rig import RIGS
from flcav.sources.randomisation import DRAWN_BEAMS
from flcav.storage.files import sha256, write_bytes
from flcav.storage.markdown import format_bullets, format_table
from flcav.storage.records import LEFT_OUT, Record

CARD_KEY = "flcav.card"  # key of the card in the metadata of a safetensors file
LICENCE = "Apache-2.0"
RECIPE_FIELDS = (
    "town",
    "seed",
    "split",
    "scenes",
    "warmup_s",
    "spins_per_scene",
    "every_s",
    "cavs",
    "poles",
    "weather",
    "randomise",
    "beams",
)
FACTS = ("parameters", "seed", "samples", "licence", "flcav", "torch", "threads", "processor")
RIG_FIELDS = ("vehicle_rig", "pole_rig")


@dataclass(frozen=True)
class TrainingProgress(Record):
    """Steps, final loss and validation scores of a training."""

    steps: int
    loss: float  # mean over the last epoch
    scores: tuple[float, ...] = ()  # on the validation data, after each epoch; empty without validation


@dataclass(frozen=True, kw_only=True)
class DataEntry:
    """Provenance of a dataset: name, frames and agents used, hash of the manifest, recipe."""

    name: str  # the last two parts of the folder's path
    frames: int  # number of frames used
    agents: Annotated[tuple[str, ...] | None, LEFT_OUT] = None  # the agents used; None in older cards
    manifest: str  # SHA-256 of the manifest
    recipe: Mapping[str, Json]  # `RECIPE_FIELDS` of the recording's recipe, and the rigs that have a name


class Card(Config):
    """Model card of a file of weights, stored as JSON in the file's metadata and as Markdown next to the file."""

    task: str
    network: str  # name of the configuration
    parameters: int
    seed: int
    samples: int
    training: Mapping[str, Json]  # settings such as epochs and batch, and the fields of `TrainingProgress`
    data: tuple[DataEntry, ...]  # training data, one entry per dataset
    validation: DataEntry | None = None  # validation data; None without
    metrics: Mapping[str, Json]  # evaluation on the validation data; empty without
    licence: str = LICENCE
    flcav: str = version("flcav")
    torch: str | None = None  # version of torch; this and the next two are None in older cards
    threads: int | None = None  # CPU threads of the training process
    processor: str | None = None  # kind of processor, see `flcav.perception.device.processor_of`

    @property
    def learning(self) -> TrainingProgress:
        """Return the record of the training; raises `InputError` if `training` lacks its fields."""
        return TrainingProgress.from_json(self.training, f"card of {self.task}, {self.network}")

    def markdown(self) -> str:
        """Return the card as Markdown, numbers rounded to 4 decimals; the metadata keeps all digits."""
        facts = {name: value for name in FACTS if (value := getattr(self, name)) is not None}
        held = [] if self.validation is None else [format_bullets([_entry(self.validation)])]
        blocks = [
            f"# {self.task}: {self.network}",
            f"A network for `flcav infer {self.task}`, trained on frames of simulated streets.",
            *_blocks(facts),
            "## Training",
            *_blocks(self.training),
            "## Data",
            format_bullets(_entry(entry) for entry in self.data),
            "## Validation",
            *held,
            *(_blocks(self.metrics) or ["- none"]),
        ]
        return "\n\n".join(blocks) + "\n"


def data_entry(data: Dataset, chosen: FrameSelection) -> DataEntry:
    """Return the card's entry of a dataset and the frames selected from it."""
    recipe = data.manifest.recipe
    rigs = {name: _rig_name(recipe[name]) for name in RIG_FIELDS if name in recipe}
    return DataEntry(
        name="/".join(data.folder.resolve().parts[-2:]),
        frames=len(chosen.frames),
        agents=tuple(chosen.agents),
        manifest=sha256(data.folder / MANIFEST),
        recipe={name: recipe[name] for name in RECIPE_FIELDS if name in recipe}
        | {name: rig for name, rig in rigs.items() if rig is not None},
    )


def write_card(card: Card, path: Path) -> None:
    """Write the card as Markdown, atomically."""
    write_bytes(path, card.markdown().encode())


def find_recorded_lidar(recipe: Mapping[str, Json], agents: Iterable[str] | None = None) -> KnownLidar:
    """Return beams and range of the agents' first LiDAR, from a recording's recipe or as an import states them.

    `recipe` is that of a manifest, or of a card's entry, which names the rig. `agents` are those whose LiDAR is meant:
    that of the poles if all are poles, else that of the vehicles. None stands for what the recipe does not state.
    """
    kinds = {kind_of(agent) for agent in agents or ()}
    rig: Any = recipe.get("pole_rig" if kinds == {POLE} else "vehicle_rig")
    known: Any = RIGS[rig].model_dump(mode="json") if isinstance(rig, str) and rig in RIGS else rig
    try:
        settings = next(iter(known["lidars"].values()))["settings"]
        beams = settings["channels"]
        range_m = settings.get("range_m")
    except (TypeError, KeyError, AttributeError, StopIteration):
        beams, range_m = recipe.get("beams"), recipe.get("range_m")
    span = (beams, beams) if isinstance(beams, int) else None
    drawing: Any = recipe.get("randomise")
    if drawing is not None and kinds != {POLE}:
        span = DRAWN_BEAMS[drawing]
    return KnownLidar(span, float(range_m) if isinstance(range_m, int | float) else None)


def join_lidars(known: Sequence[KnownLidar]) -> KnownLidar:
    """Return the common knowledge of LiDARs: fewest and most beams, and the range [m] if it is the same for all."""
    spans = [lidar.beams for lidar in known if lidar.beams is not None]
    beams = (min(low for low, _ in spans), max(high for _, high in spans)) if spans else None
    ranges = {lidar.range_m for lidar in known}
    return KnownLidar(beams if len(spans) == len(known) else None, ranges.pop() if len(ranges) == 1 else None)


def _rig_name(rig: Any) -> str | None:
    return next((name for name, known in RIGS.items() if known.model_dump(mode="json") == rig), None)


def _entry(entry: DataEntry) -> str:
    recipe = {name: value for name, value in entry.recipe.items() if value not in ([], {}, None)}
    frames = plural(entry.frames, "frame") + (f" of {', '.join(entry.agents)}" if entry.agents is not None else "")
    return f"{entry.name}: {frames}; {_text(recipe)}; SHA-256 of its manifest {entry.manifest}"


def _blocks(values: Mapping[str, Json]) -> list[str]:
    """Return Markdown blocks: a list of the values that fit on a line, then a titled table for each other value."""
    tables = {name: _table(value, values.get("classes")) for name, value in values.items()}
    plain = [f"{name}: {_text(value)}" for name, value in values.items() if tables[name] is None]
    named = [f"### {name}\n\n{text}" for name, text in tables.items() if text is not None]
    return ([format_bullets(plain)] if plain else []) + named


def _table(value: Any, classes: Any) -> str | None:
    """Return a Markdown table of a list or mapping of records, or of a confusion matrix; None for any other value."""
    rows = value
    if isinstance(value, Mapping):
        rows = [{"": name} | dict(row) for name, row in value.items() if isinstance(row, Mapping)]
    if not isinstance(rows, list) or not rows:
        return None
    if isinstance(rows[0], list) and isinstance(classes, list) and len(classes) == len(rows):
        rows = [{"": name} | dict(zip(classes, row, strict=True)) for name, row in zip(classes, rows, strict=True)]
    if not all(isinstance(row, Mapping) for row in rows):
        return None
    header = list(dict.fromkeys(name for row in rows for name in row))
    return format_table(header, [[_text(row.get(name)) for name in header] for row in rows])


def _text(value: Any) -> str:
    """Return a value on one line: nested values in brackets, empty ones left out."""
    if isinstance(value, float):
        return f"{round(value, 4):g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_nested(part)}" for name, part in value.items() if part not in ([], {}, None))
    if isinstance(value, list | tuple):
        return ", ".join(map(_nested, value)) or "none"
    return "none" if value is None else str(value)


def _nested(value: Any) -> str:
    if isinstance(value, list | tuple) and len(value) == 1:
        return _nested(value[0])
    return f"({_text(value)})" if isinstance(value, Mapping | list | tuple) else _text(value)


PREFIX = "flcav."
LARGEST = 1e9  # largest absolute value of a weight; larger ones overflow in a few layers
PACKAGED = "packaged"  # names the weights of a task that come with the package, in place of a file
SHIPPED = "shipped/weights.safetensors"  # relative to the folder of a task's module
KINDS = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64)  # of numbers in a file
COUNTER = "num_batches_tracked"  # buffer of batch normalisation, unused with a fixed momentum


def find_shipped(task: Task, name: str = SHIPPED) -> Path:
    """Return the path of the task's weights in the package; raises `InputError` if there are none.

    `name` is that of another network of the package, relative to the folder of the task's module.
    """
    module = sys.modules.get(type(task).__module__)
    path = Path(getattr(module, "__file__", None) or "").parent / name
    if not path.is_file():
        raise InputError(f"--weights is missing: no weights of '{task.family}' come with the package, train some first")
    return path


def find_weights(task: Task, named: Path | str | None) -> Path:
    """Return the file of weights `named`; for None and `PACKAGED`, the task's packaged weights (`find_shipped`)."""
    return find_shipped(task) if named is None or str(named) == PACKAGED else Path(named)


def read_family(path: Path | str) -> str | None:
    """Return the family of networks that a file of weights is of; None where it does not say.

    Raises `DamagedFile` for what is no safetensors file.
    """
    return _find_family(_opened(Path(path))[0])


def _find_family(metadata: Mapping[str, str]) -> str | None:
    found = (name.removeprefix(PREFIX) for name in metadata if name.startswith(PREFIX) and name != CARD_KEY)
    return next(found, None)


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

    Raises `InputError` for any other file, for weights that are not finite, and where `task` is the name of a task.
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
        found = _find_family(metadata)
        said = f"no '{key}' in the file's metadata" if found is None else f"of '{found}'"
        raise InputError(
            f"{path}: weights of another network ({said}); '{task.name}' takes those of '{task.family}', "
            "and a network of your own has a task of your own, named module:NAME"
        )
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
