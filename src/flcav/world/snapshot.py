"""Snapshots of a live world: all actors, traffic lights and collisions at one instant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Ints, Mask
from flcav.world.commands import Controls
from flcav.world.trace import Trace


@dataclass(frozen=True)
class Collision:
    """A collision of a controlled actor with another actor or an obstacle of the town, during one step."""

    name: str  # the controlled actor
    other: str  # the other actor, or an obstacle "kind:row": building, tree, clutter, post, lamp, sign, pole, signal
    impulse: tuple[float, float]  # x, y on the controlled actor [N s], world frame; the other one gets its opposite
    point: tuple[float, float]  # x, y of the contact [m], world frame


@dataclass(frozen=True)
class Snapshot:
    """The state of a live world at one instant; its arrays are read-only."""

    step: int  # number of steps since the start
    time_s: float  # time since the start [s]
    trace: Trace  # one instant of all actors: controlled ones in the order of spawning, SUMO's, parked vehicles
    controls: Mapping[str, Controls]  # of the controlled vehicles
    collisions: tuple[Collision, ...]  # during the last step

    def __post_init__(self) -> None:
        for field in fields(self.trace):
            if isinstance(array := getattr(self.trace, field.name), np.ndarray):
                array.flags.writeable = False

    def row(self, name: str) -> int:
        """Return the row of an actor in the trace. Raises `KeyError` where it is absent."""
        rows = np.flatnonzero(self.trace.actor == name)
        if not len(rows):
            raise KeyError(name)
        return int(rows[0])


def join_snapshots(snapshots: Sequence[Snapshot]) -> Trace:
    """Join one snapshot or more, in ascending order of time, to a trace of all their actors.

    Raises `ValueError` without snapshots, and where an actor's category, shape or size differs between snapshots.
    """
    if not snapshots:
        raise ValueError("a trace needs at least one snapshot")
    names = list(dict.fromkeys(name for snapshot in snapshots for name in snapshot.trace.actor.tolist()))
    row = {name: i for i, name in enumerate(names)}
    count, actors = len(snapshots), len(names)
    known: dict[str, tuple[str, int, tuple[float, ...]]] = {}
    present = np.zeros((count, actors), np.bool_)
    axes = {"position": (3,), "velocity": (3,), "acceleration": (3,), "yaw": (), "yaw_rate": ()}
    motion = {name: np.full((count, actors, *shape), np.nan) for name, shape in axes.items()}
    tilt = np.full((count, actors, 2), np.nan)
    for i, snapshot in enumerate(snapshots):
        trace = snapshot.trace
        at = [row[name] for name in trace.actor.tolist()]
        for actor, name in enumerate(trace.actor.tolist()):
            if known.setdefault(name, trace.model(actor)) != trace.model(actor):
                raise ValueError(f"actor '{name}' is not the same in all snapshots")
        present[i, at] = True
        for name, array in motion.items():
            array[i, at] = getattr(trace, name)[0]
        tilt[i, at] = trace.tilts(0)
    category, shape, size = zip(*(known[name] for name in names)) if names else ((), (), ())
    last = snapshots[-1].trace
    return replace(
        last,
        time_s=np.array([snapshot.time_s for snapshot in snapshots]),
        actor=np.array(names, np.str_),
        category=np.array(category, np.str_),
        shape=np.array(shape, np.int64),
        size=np.array(size, np.float64).reshape(-1, 3),
        present=present,
        light_state=np.concatenate([snapshot.trace.light_state for snapshot in snapshots]),
        tilt=None if all(snapshot.trace.tilt is None for snapshot in snapshots) else tilt,
        **motion,
    )


class Actors(NamedTuple):
    """N actors at one instant, world frame: the fields of a `Trace`."""

    name: tuple[str, ...]  # (N,)
    category: tuple[str, ...]  # (N,)
    shape: Ints  # (N,) row of SHAPES[category]
    size: Array  # (N, 3) length, width, height [m]
    position: Array  # (N, 3) ground centre [m]
    yaw: Array  # (N,) [rad]
    velocity: Array  # (N, 3) [m/s]
    acceleration: Array  # (N, 3) [m/s^2]
    yaw_rate: Array  # (N,) [rad/s]
    tilt: Array  # (N, 2) pitch and roll [rad]

    @property
    def places(self) -> Array:
        """The actors' x, y [m] and yaw [rad] (N, 3)."""
        return np.column_stack((self.position[:, :2], self.yaw))


_ONES, _TWOS, _THREES = np.zeros(0), np.zeros((0, 2)), np.zeros((0, 3))
NOBODY = Actors((), (), np.zeros(0, np.int64), _THREES, _THREES, _ONES, _THREES, _THREES, _ONES, _TWOS)


def pick_actors(actors: Actors, mask: Mask) -> Actors:
    """Select the actors for which `mask` (N,) is true."""
    names, categories = (tuple(compress(words, mask)) for words in actors[:2])
    return Actors(names, categories, actors.shape[mask], *(column[mask] for column in actors[3:]))


def join_actors(*parts: Actors) -> Actors:
    """Concatenate actors, in order."""
    return Actors(
        tuple(name for part in parts for name in part.name),
        tuple(category for part in parts for category in part.category),
        *(np.concatenate(column) for column in zip(*(part[2:] for part in parts))),
    )
