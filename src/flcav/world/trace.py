"""Traffic traces: the motion of all actors, the signal states and the scripted events of one traffic run."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flcav.arrays import Array, Ints, Mask, Words
from flcav.config import InputError
from flcav.geometry import rotations
from flcav.storage.files import atomic_path, read_parquet
from flcav.world.shapes import SHAPES

CATEGORIES = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
METADATA = b"flcav.trace"
STATE = (
    *("x", "y", "z", "yaw"),
    *("velocity_x", "velocity_y", "velocity_z"),
    *("acceleration_x", "acceleration_y", "acceleration_z"),
    "yaw_rate",
)
TILT = ("pitch", "roll")  # further columns, of traces on a relief


class Event(NamedTuple):
    """A scripted corner case that has happened."""

    kind: str  # as `Scenario.kind`
    begins_s: float  # start of the action, as in `Trace.time_s` [s]
    actors: tuple[str, ...]  # track ids of the participants; one of them may be absent from the whole trace


@dataclass(frozen=True)
class Trace:
    """A traffic run: the motion of A actors at T instants, in the world frame.

    An actor's position is that of its ground centre, the centre of the underside of its box.

    >>> from flcav import Dataset, Trace
    >>> trace: Trace = Dataset.open("data").trace("grid-0-000")
    >>> trace.position.shape == (len(trace.time_s), len(trace.actor), 3)
    True
    """

    town: str  # name of the town
    time_s: Array  # (T,) ascending, from the start of the traffic [s]
    actor: Words  # (A,) track ids, e.g. "cav0", "veh17", "parked3", "ped8"
    category: Words  # (A,) one of CATEGORIES; "prop" for props that a client has spawned in a live world
    shape: Ints  # (A,) row of SHAPES[category], for props of PROPS
    size: Array  # (A, 3) length, width, height [m]
    present: Mask  # (T, A) whether the actor is in the town
    position: Array  # (T, A, 3) ground centre [m]; NaN where absent
    yaw: Array  # (T, A) [rad]; NaN where absent
    velocity: Array  # (T, A, 3) [m/s]; NaN where absent
    acceleration: Array  # (T, A, 3) [m/s^2]; NaN where absent
    yaw_rate: Array  # (T, A) [rad/s]; NaN where absent
    light: Words  # (L,) ids of signals, "junction:link index"
    light_state: Words  # (T, L) one SUMO state letter: G g y r ...
    events: tuple[Event, ...] = ()
    tilt: Array | None = None  # (T, A, 2) pitch and roll [rad], as in `geometry.pose`; NaN if absent; None: all level
    bow: Array | None = None  # (A,) bow of the ends of its body [m], see `meshes.mesh.bow_ends`; None: all are flat

    def model(self, actor: int) -> tuple[str, int, tuple[float, ...]]:
        """Return the arguments of `actor_mesh` for an actor: category, shape, and size with the bow, if any [m]."""
        bow = () if self.bow is None else (float(self.bow[actor]),)
        return str(self.category[actor]), int(self.shape[actor]), (*self.size[actor].tolist(), *bow)

    def tilts(self, index: int) -> Array:
        """Return the actors' pitch and roll (A, 2) [rad] at an instant."""
        return np.zeros((len(self.actor), 2)) if self.tilt is None else self.tilt[index]

    def box_centres(self, index: int) -> Array:
        """Return the centres (A, 3) [m] of the actors' boxes at an instant; NaN where absent."""
        middle = self.size * (0, 0, 0.5)
        if self.tilt is not None:
            middle = (rotations(self.yaw[index], *self.tilt[index].T) @ middle[..., None])[..., 0]
        return self.position[index] + middle

    def save(self, path: Path | str) -> None:
        """Write the trace as a Parquet file: a row per instant and present actor, the rest in the file's metadata."""
        instant, actor = np.nonzero(self.present)
        motion = (self.position, self.yaw[..., None], self.velocity, self.acceleration, self.yaw_rate[..., None])
        state = np.concatenate(motion, axis=2)[instant, actor]
        columns = {"instant": instant.astype(np.int32), "actor": actor.astype(np.int32)}
        columns |= {name: state[:, i] for i, name in enumerate(STATE)}
        if self.tilt is not None:
            columns |= dict(zip(TILT, self.tilt[instant, actor].T))
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
        if self.bow is not None:
            rest["bow"] = self.bow.tolist()
        if self.events:
            rest["events"] = [event._asdict() for event in self.events]
        table = pa.table(columns).replace_schema_metadata({METADATA: json.dumps(rest)})
        with atomic_path(Path(path)) as temporary:
            pq.write_table(table, temporary)

    @classmethod
    def load(cls, path: Path | str) -> "Trace":
        """Load the trace that `save` wrote. Raises `InputError` where `path` is missing or not a trace."""
        table = read_parquet(Path(path))
        metadata = table.schema.metadata or {}
        if METADATA not in metadata:
            raise InputError(f"{path}: not a trace (Parquet without the metadata {METADATA.decode()!r})")
        if missing := [name for name in STATE if name not in table.column_names]:
            raise InputError(f"{path}: a trace of another version (no column '{missing[0]}'); record it again")
        try:
            return cls._decode(json.loads(metadata[METADATA]), table)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}: not a trace ({type(error).__name__}: {error})") from None

    @classmethod
    def _decode(cls, rest: dict[str, Any], table: pa.Table) -> "Trace":
        """Decode a trace from a file's metadata and rows.

        Raises `ValueError` and others where they are inconsistent.
        """
        instants, actors, lights = len(rest["time_s"]), len(rest["actor"]), len(rest["light"])
        at = (table["instant"].to_numpy(), table["actor"].to_numpy())
        if min(column.min(initial=0) for column in at) < 0:
            raise ValueError("a row is of no instant or no actor")
        state = np.full((instants, actors, len(STATE)), np.nan)
        state[at] = np.stack([table[name].to_numpy() for name in STATE], axis=1)
        tilt = None
        if set(TILT) <= set(table.column_names):
            tilt = np.full((instants, actors, 2), np.nan)
            tilt[at] = np.stack([table[name].to_numpy() for name in TILT], axis=1)
        present = np.zeros((instants, actors), dtype=np.bool_)
        present[at] = True
        light_state = np.full((instants, lights), "", dtype="<U1")
        for since, letters in rest["light_state"]:
            light_state[since:] = list(letters)
        trace = cls(
            town=str(rest["town"]),
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
            tilt=tilt,
            bow=np.array(rest["bow"], dtype=np.float64) if "bow" in rest else None,
        )
        trace._check()
        return trace

    def _check(self) -> None:
        """Raise `ValueError` where fields are inconsistent, a number is not finite, or times do not ascend."""
        if {len(names) for names in (self.actor, self.category, self.shape, self.size)} != {
            len(set(self.actor.tolist()))
        }:
            raise ValueError("its actors are not told one by one")
        for category, shape in zip(self.category.tolist(), self.shape.tolist()):
            if not 0 <= shape < len(SHAPES.get(category, ())):
                raise ValueError(f"there is no {category!r} of shape {shape}")
        motion = (self.position, self.velocity, self.acceleration, self.yaw[..., None], self.yaw_rate[..., None])
        tilts = np.zeros(0) if self.tilt is None else self.tilt[self.present]
        numbers = (np.concatenate(motion, axis=2)[self.present], self.time_s, self.size, tilts)
        if not all(np.isfinite(values).all() for values in numbers):
            raise ValueError("a number is not finite")
        if self.bow is not None and not (
            self.bow.shape == self.actor.shape and ((self.bow >= 0) & (self.bow < 1)).all()
        ):
            raise ValueError("a bow is not of an actor, or not within 0 and 1 m")
        if (self.size <= 0).any() or (np.diff(self.time_s) <= 0).any():
            raise ValueError("a size is not above 0, or time does not go on")


def empty_trace(town: str) -> Trace:
    """Return a trace of one instant without actors, in the town of this name."""
    none, instant = np.zeros((1, 0)), np.zeros((1, 0, 3))
    words = np.array([], np.str_)
    return Trace(
        town=town,
        time_s=np.zeros(1),
        actor=words,
        category=words,
        shape=np.zeros(0, np.int64),
        size=np.zeros((0, 3)),
        present=np.zeros((1, 0), np.bool_),
        position=instant,
        yaw=none,
        velocity=instant,
        acceleration=instant,
        yaw_rate=none,
        light=words,
        light_state=np.zeros((1, 0), np.str_),
    )


def find_instant(trace: Trace, track: str, at: Array | tuple[float, float]) -> int | None:
    """Return the instant (row) at which a road user of a trace is nearest to x, y [m]; None where it is not there."""
    rows = np.flatnonzero(trace.actor == track)
    if not len(rows):
        return None
    far = np.hypot(*(trace.position[:, rows[0], :2] - np.asarray(at)[:2]).T)
    return None if np.isnan(far).all() else int(np.nanargmin(far))
