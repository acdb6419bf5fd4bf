"""The error registry: where a network was wrong in a town, each mistake once: sensors are placed by it.

What a mistake is, each task says in its own `errors.py`; here is how they are kept and handed on.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flcav.dataset.exchange import write_table
from flcav.dataset.store import Dataset
from flcav.progress import Report, silent

if TYPE_CHECKING:
    from torch import nn

    from flcav.perception.agents import Chosen

SAME_PLACE_M = 2.0  # false positives of one scene within this of one another are one

THRESHOLD = 0.3  # lowest score of a detection, unless one is told otherwise
MISS, FALSE_POSITIVE, FINAL_ERROR = "miss", "false_positive", "final_error"
CLASS = "class"  # the column of `PerceptionError.label`


@dataclass(frozen=True)
class PerceptionError:
    """One registered mistake."""

    x: float  # world [m]; of an object its geometric centre
    y: float
    z: float
    weight: float  # what covering it is worth
    kind: str  # miss | false_positive | final_error
    label: str  # class of what was missed or invented
    returns: int  # LiDAR returns in it; 0 where no LiDAR is asked
    occlusion: float  # of a missed object, [0, 1]; NaN where it is not known
    scene: str
    track: str  # the object's; false positives are numbered per scene


@dataclass(frozen=True)
class Registry:
    """All mistakes of a network on a dataset."""

    errors: tuple[PerceptionError, ...]
    dropped: int = 0  # false positives that point at no place of the town
    chosen: "Chosen | None" = None  # whose frames, where that is known

    def __len__(self) -> int:
        return len(self.errors)

    def __iter__(self) -> Iterator[PerceptionError]:
        return iter(self.errors)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Return where the mistakes are, (N, 3) world [m]."""
        return np.array([(error.x, error.y, error.z) for error in self.errors]).reshape(-1, 3)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Return what covering each is worth, (N,)."""
        return np.array([error.weight for error in self.errors], np.float64)

    @property
    def kinds(self) -> NDArray[np.str_]:
        """Return the kind of each, (N,): miss, false_positive or final_error."""
        return np.array([error.kind for error in self.errors], np.str_)


@runtime_checkable
class RegistersErrors(Protocol):
    """A task whose mistakes have a place in the town."""

    def register_errors(
        self,
        network: "nn.Module",
        data: Dataset,
        frames: Sequence[int] | None,
        threshold: float,
        progress: Report = silent,
    ) -> Registry:
        """Return what `network` misses and invents in the frames; detections below `threshold` are none.

        Raises `InputError` where the dataset lacks what that takes.
        """
        ...


def keep_first(errors: Iterable[PerceptionError]) -> tuple[PerceptionError, ...]:
    """Return each mistake where and as it was first made, false positives numbered per scene.

    A missed object is one mistake per track and scene; so are false positives of a class within `SAME_PLACE_M`.
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


def save_errors(errors: Sequence[PerceptionError], path: Path) -> None:
    """Write the registry as Parquet or CSV, by the ending of `path`; raises `InputError` for another one.

    A column per field of `PerceptionError`, its `label` called "class": what `flcav place` reads.
    """
    kinds = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in PerceptionError.__annotations__.items()])
    table = pa.Table.from_pylist([asdict(error) for error in errors], schema=schema)
    table = table.rename_columns([CLASS if name == "label" else name for name in table.column_names])
    write_table(table, path)


def load_errors(path: Path) -> tuple[PerceptionError, ...]:
    """Return the registry that `save_errors` wrote as Parquet."""
    rows = pq.read_table(path).to_pylist()
    return tuple(PerceptionError(**{("label" if name == CLASS else name): row[name] for name in row}) for row in rows)


def _distance(a: PerceptionError, b: PerceptionError) -> float:
    return float(np.linalg.norm([a.x - b.x, a.y - b.y, a.z - b.z]))
