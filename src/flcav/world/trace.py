"""A traffic run as one immutable table: who was where, when."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.files import atomic_path

Array = NDArray[np.float64]

CATEGORIES = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
METADATA = b"flcav.trace"
STATE = (
    *("x", "y", "z", "yaw"),
    *("velocity_x", "velocity_y", "velocity_z"),
    *("acceleration_x", "acceleration_y", "acceleration_z"),
    "yaw_rate",
)


class Event(NamedTuple):
    """A scripted corner case that happened."""

    kind: str
    begins_s: float  # when those who take part begin to act
    actors: tuple[str, ...]  # track ids; may name somebody absent at all of the trace's instants


@dataclass(frozen=True)
class Trace:
    """T instants of A actors; an actor's pose is its ground centre, world frame."""

    town: str
    time_s: Array  # (T,)
    actor: NDArray[np.str_]  # (A,) track ids, e.g. "cav0", "veh17", "parked3", "ped8"
    category: NDArray[np.str_]  # (A,) one of CATEGORIES
    shape: NDArray[np.int64]  # (A,) index of the mesh variant within the category
    size: Array  # (A, 3) length, width, height [m]
    present: NDArray[np.bool_]  # (T, A)
    position: Array  # (T, A, 3) ground centre [m]; NaN where absent
    yaw: Array  # (T, A) [rad]; NaN where absent
    velocity: Array  # (T, A, 3) [m/s]; NaN where absent
    acceleration: Array  # (T, A, 3) [m/s^2]; NaN where absent
    yaw_rate: Array  # (T, A) [rad/s]; NaN where absent
    light: NDArray[np.str_]  # (L,) traffic light ids (junction:link index)
    light_state: NDArray[np.str_]  # (T, L) one SUMO state letter: G g y r ...
    events: tuple[Event, ...] = ()

    def save(self, path: Path) -> None:
        """Write the trace as one Parquet file: a row per instant and present actor, the rest in the file's metadata."""
        instant, actor = np.nonzero(self.present)
        motion = (self.position, self.yaw[..., None], self.velocity, self.acceleration, self.yaw_rate[..., None])
        state = np.concatenate(motion, axis=2)[instant, actor]
        columns = {"instant": instant.astype(np.int32), "actor": actor.astype(np.int32)}
        columns |= {name: state[:, i] for i, name in enumerate(STATE)}
        changed = [0, *(np.flatnonzero((self.light_state[1:] != self.light_state[:-1]).any(axis=1)) + 1).tolist()]
        rest = {
            "town": self.town,
            "time_s": self.time_s.tolist(),
            "actor": self.actor.tolist(),
            "category": self.category.tolist(),
            "shape": self.shape.tolist(),
            "size": self.size.tolist(),
            "light": self.light.tolist(),
            "light_state": [[i, "".join(self.light_state[i])] for i in changed if i < len(self.time_s)],
        }
        if self.events:
            rest["events"] = [event._asdict() for event in self.events]
        table = pa.table(columns).replace_schema_metadata({METADATA: json.dumps(rest)})
        with atomic_path(path) as temporary:
            pq.write_table(table, temporary)

    @classmethod
    def load(cls, path: Path) -> "Trace":
        """Read a trace that `save` wrote; raises `InputError` where `path` is none."""
        try:
            table = pq.read_table(path)
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        except pa.ArrowInvalid as error:
            raise InputError(f"{path}: not a trace ({error})") from None
        metadata = table.schema.metadata or {}
        if METADATA not in metadata:
            raise InputError(f"{path}: not a trace (Parquet without the metadata {METADATA.decode()!r})")
        rest = json.loads(metadata[METADATA])
        if missing := [name for name in STATE if name not in table.column_names]:
            raise InputError(f"{path}: a trace of another version (no column '{missing[0]}'); record it again")
        instants, actors, lights = len(rest["time_s"]), len(rest["actor"]), len(rest["light"])
        at = (table["instant"].to_numpy(), table["actor"].to_numpy())
        state = np.full((instants, actors, len(STATE)), np.nan)
        state[at] = np.stack([table[name].to_numpy() for name in STATE], axis=1)
        present = np.zeros((instants, actors), dtype=np.bool_)
        present[at] = True
        light_state = np.full((instants, lights), "", dtype="<U1")
        for since, letters in rest["light_state"]:
            light_state[since:] = list(letters)
        return cls(
            town=rest["town"],
            time_s=np.array(rest["time_s"], dtype=np.float64),
            actor=np.array(rest["actor"], dtype=np.str_),
            category=np.array(rest["category"], dtype=np.str_),
            shape=np.array(rest["shape"], dtype=np.int64),
            size=np.array(rest["size"], dtype=np.float64).reshape(-1, 3),
            present=present,
            position=state[..., :3],
            yaw=state[..., 3],
            velocity=state[..., 4:7],
            acceleration=state[..., 7:10],
            yaw_rate=state[..., 10],
            light=np.array(rest["light"], dtype=np.str_),
            light_state=light_state,
            events=tuple(Event(row["kind"], row["begins_s"], tuple(row["actors"])) for row in rest.get("events", [])),
        )
