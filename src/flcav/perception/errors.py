"""The error registry: a network's mistakes with their positions in a town, without duplicates.

Roadside sensors are placed by it. Each task's `register_errors` defines what a mistake is; this module holds the
records, removes duplicates, and reads and writes files.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flcav.arrays import Array, Words
from flcav.dataset.store import Dataset
from flcav.interface.notebook import Displayed
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.storage.records import write_any_table

if TYPE_CHECKING:
    from torch import nn

    from flcav.perception.agents import FrameSelection

SAME_PLACE_M = 2.0  # false positives of one scene this close to one another are duplicates

THRESHOLD = 0.3  # default score threshold of a detection
MISS, FALSE_POSITIVE, FINAL_ERROR = "miss", "false_positive", "final_error"
CLASS = "class"  # name of the column of `PerceptionError.label` in files


@dataclass(frozen=True)
class PerceptionError:
    """A registered mistake: a missed object, a false positive, or a forecast with a large final error."""

    x: float  # world frame [m]; for an object its geometric centre
    y: float
    z: float
    weight: float  # gain of covering it with a sensor
    kind: str  # miss | false_positive | final_error
    label: str  # class of the missed object, or of the false positive
    returns: int  # LiDAR returns inside the object; 0 for tasks without LiDAR
    occlusion: float  # of a missed object, in [0, 1]; NaN if unknown
    scene: str
    track: str  # track of the object; false positives are numbered per scene
    distance_m: float = float("nan")  # from the vehicle in whose frame it was made, on the ground [m]; NaN if unknown


@dataclass(frozen=True)
class Registry(Displayed):
    """All registered mistakes of a network on a dataset."""

    errors: tuple[PerceptionError, ...]
    dropped: int = 0  # number of false positives without a position in the town
    chosen: "FrameSelection | None" = None  # the frames that were tested, if known
    found: Mapping[int, Sequence[PerceptionError]] | None = None  # by frame, with duplicates; None: unknown
    standing: bool = False  # whether missed objects are fixed in the town, and so the same in every scene

    @classmethod
    def of(
        cls, found: Mapping[int, Sequence[PerceptionError]], *, dropped: int = 0, standing: bool = False
    ) -> "Registry":
        """Return the registry of the mistakes in all frames, in the order of `found`, without duplicates."""
        every = [error for errors in found.values() for error in errors]
        if standing:
            missed: dict[str, PerceptionError] = {}
            for error in every:
                if error.kind == MISS:
                    missed.setdefault(error.track, error)
            every = [*missed.values(), *(error for error in every if error.kind != MISS)]
        return cls(keep_first(every), dropped, found=found, standing=standing)

    def __len__(self) -> int:
        return len(self.errors)

    def __iter__(self) -> Iterator[PerceptionError]:
        return iter(self.errors)

    @property
    def positions(self) -> Array:
        """Return the positions (N, 3) of the mistakes: x, y, z in the world frame [m]."""
        return np.array([(error.x, error.y, error.z) for error in self.errors]).reshape(-1, 3)

    @property
    def weights(self) -> Array:
        """Return the gain of covering each mistake, (N,)."""
        return np.array([error.weight for error in self.errors], np.float64)

    @property
    def kinds(self) -> Words:
        """Return the kind of each mistake, (N,): miss, false_positive or final_error."""
        return np.array([error.kind for error in self.errors], np.str_)


@runtime_checkable
class RegistersErrors(Protocol):
    """A task whose mistakes have a position in the town."""

    def register_errors(
        self,
        network: "nn.Module",
        data: Dataset,
        frames: Sequence[int] | None,
        threshold: float,
        progress: Report = ignore_progress,
    ) -> Registry:
        """Return the mistakes of `network` in the frames (None: all); detections scoring below `threshold` are ignored.

        Raises `InputError` if the dataset lacks the ground truth, the town or the sensors for that.
        """
        ...


def keep_first(errors: Iterable[PerceptionError]) -> tuple[PerceptionError, ...]:
    """Return the mistakes without duplicates: the first of each group, in order, false positives numbered per scene.

    Duplicates are mistakes with the same track and scene, and false positives of one scene, of whatever class, within
    `SAME_PLACE_M` of one that is kept.
    """
    kept: dict[tuple[str, str], PerceptionError] = {}
    for error in errors:
        if error.kind != FALSE_POSITIVE:
            kept.setdefault((error.scene, error.track), error)
            continue
        known = [other for other in kept.values() if other.kind == FALSE_POSITIVE and other.scene == error.scene]
        if not any(_distance(other, error) <= SAME_PLACE_M for other in known):
            track = f"{FALSE_POSITIVE}{len(known)}"
            kept[error.scene, track] = replace(error, track=track)
    return tuple(kept.values())


def is_among(error: PerceptionError, others: Iterable[PerceptionError], *, standing: bool = False) -> bool:
    """Return whether the same mistake is among `others`; `standing`: as in `Registry`.

    A miss or forecast is the same where scene and track are, a false positive within `SAME_PLACE_M` in the same scene.
    """
    alike = [other for other in others if other.kind == error.kind]
    if error.kind == FALSE_POSITIVE:
        return any(other.scene == error.scene and _distance(other, error) <= SAME_PLACE_M for other in alike)
    return any(other.track == error.track and (standing or other.scene == error.scene) for other in alike)


def measure_distance(world_from_agent: Array, x: float, y: float) -> float:
    """Return the distance on the ground [m] of a place in the world from a vehicle, whose pose (4, 4) is given."""
    return float(np.hypot(*(world_from_agent[:2, 3] - (x, y))))


def save_errors(errors: Sequence[PerceptionError], path: Path) -> None:
    """Write mistakes as Parquet or CSV, by the suffix of `path`; raises `InputError` for any other suffix.

    The table has a column per field of `PerceptionError`, `label` under the name "class"; `flcav place` reads it.
    """
    kinds = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in PerceptionError.__annotations__.items()])
    table = pa.Table.from_pylist([asdict(error) for error in errors], schema=schema)
    table = table.rename_columns([CLASS if name == "label" else name for name in table.column_names])
    write_any_table(table, path)


def load_errors(path: Path) -> tuple[PerceptionError, ...]:
    """Return the mistakes in a Parquet file that `save_errors` wrote; files of earlier versions have no distances."""
    rows = pq.read_table(path).to_pylist()
    return tuple(PerceptionError(**{("label" if name == CLASS else name): row[name] for name in row}) for row in rows)


def pack_errors(errors: Sequence[PerceptionError]) -> bytes:
    """Return mistakes as the message by which a vehicle reports them."""
    arrays: dict[str, NDArray] = {}
    for name, kind in PerceptionError.__annotations__.items():
        values = [getattr(error, name) for error in errors]
        arrays[name] = from_names(values) if kind is str else np.array(values, dtype=kind)
    return pack_arrays(arrays)


def unpack_errors(message: bytes) -> tuple[PerceptionError, ...]:
    """Return the mistakes in a message: the inverse of `pack_errors`."""
    arrays, kinds = unpack_arrays(message), PerceptionError.__annotations__
    columns = ((to_names(arrays[name]) if kind is str else arrays[name]).tolist() for name, kind in kinds.items())
    return tuple(PerceptionError(*row) for row in zip(*columns, strict=True))


def _distance(a: PerceptionError, b: PerceptionError) -> float:
    return float(np.linalg.norm([a.x - b.x, a.y - b.y, a.z - b.z]))
