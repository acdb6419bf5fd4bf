"""The surroundings that a driver perceives: the record, ground truth as a perception, and tasks that are left out.

All tasks of perception end in `Seen`: `objects` in the boxes, `trajectory` in the paths, `signs` in the lights,
`weather` in the speed. World frame: ENU, metres, radians, seconds.

A task is left out by one of two couplings. In the *bare* one nobody is seen without `objects`, everybody is taken to
stand without `trajectory`, no light is known without `signs`, and without `weather` the driver keeps to the limit in
any. In the *cautious* one the driver knows what is missing: it drives slower, and tracks keep their velocity. How much
the ranking of tasks depends on this choice is what the two show.

The true perception knows positions and velocities. What road users are going to do nobody knows in a live world, so
that their paths are predicted with constant speed and turn rate here, too.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Array, Boxes, heading_vectors, wrap_angle
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot

TIMES_S: Array = np.arange(0.0, 4.01, 0.25)  # of the points of predicted paths, from the present on
EGO = "ego"
WEATHER_SPEED: Mapping[str, float] = {  # share of the speed limit that a driver keeps to in each class of weather
    "clear": 1.0,
    "cloudy": 1.0,
    "overcast": 1.0,
    "sunset": 1.0,
    "night": 0.9,
    "light_rain": 0.9,
    "heavy_rain": 0.75,
    "fog": 0.6,
}


@dataclass(frozen=True)
class Seen:
    """The surroundings of the ego vehicle at one instant, as its perception has them."""

    boxes: Boxes  # (N,) road users
    velocity: Array  # (N, 2) over ground [m/s]
    path: Array  # (N, T, 2) predicted positions at `TIMES_S` [m]
    yaw: Array  # (N, T) predicted headings [rad]
    spread: Array  # (N, T) standard deviation of the predicted position, along each axis [m]
    closed: frozenset[str]  # entries of `Trace.light` that are seen not to be green
    amber: frozenset[str]  # those of them that are yellow
    speed_share: float = 1.0  # of the speed limit, for the weather
    found_by: str = "the truth"  # what the boxes are of


class Perception(Protocol):
    """The interface of a driver's perception: from the world to its perceived surroundings."""

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the perceived surroundings at this instant; called once for every decision, in order of time."""
        ...


def predict_motion(boxes: Boxes, velocity: Array, yaw_rate: Array | None = None) -> tuple[Array, Array]:
    """Return paths (N, T, 2) [m] and headings (N, T) [rad] at `TIMES_S`: constant velocity, and turn rate if given.

    The chord of the arc is used (Schubert et al., FUSION 2008, CTRV); `yaw_rate` is (N,) [rad/s].
    """
    turn = np.zeros((len(boxes), 1)) if yaw_rate is None else yaw_rate[:, None] * TIMES_S
    half = turn / 2
    speed, course = np.linalg.norm(velocity, axis=1), np.arctan2(velocity[:, 1], velocity[:, 0])
    chord = speed[:, None] * TIMES_S * np.sinc(half / np.pi)
    path = boxes.center[:, None, :2] + chord[..., None] * heading_vectors(course[:, None] + half)
    return path, np.asarray(wrap_angle(boxes.yaw[:, None] + np.broadcast_to(turn, chord.shape)))


Coupling = Literal["bare", "cautious"]

TASKS = ("objects", "trajectory", "signs", "weather")
SLOWER: Mapping[str, float] = {  # share of the limit in the cautious coupling
    "objects": 0.3,
    "trajectory": 1.0,
    "signs": 0.5,
    "weather": min(WEATHER_SPEED.values()),
}
FEEDS: Mapping[str, str] = {
    "objects": "boxes and velocities of road users: whom to follow and to brake for",
    "trajectory": "where they will be in the next four seconds: whom to let pass",
    "signs": "lights that are red or yellow: where to stop (signs of speed limits and stop signs feed nothing)",
    "weather": "the share of the speed limit: slower at night, in rain and in fog",
}


def leave_out(seen: Seen, task: str, coupling: Coupling) -> Seen:
    """Return the perceived surroundings without the output of a task."""
    if task == "objects":
        none = np.zeros((0, len(TIMES_S)))
        seen = replace(
            seen,
            boxes=Boxes.empty(),
            velocity=np.zeros((0, 2)),
            path=np.zeros((0, len(TIMES_S), 2)),
            yaw=none,
            spread=none,
        )
    elif task == "trajectory":
        moving = seen.velocity if coupling == "cautious" else np.zeros_like(seen.velocity)
        path, yaw = predict_motion(seen.boxes, moving)
        seen = replace(seen, path=path, yaw=yaw)
    elif task == "signs":
        seen = replace(seen, closed=frozenset(), amber=frozenset())
    else:
        seen = replace(seen, speed_share=1.0)
    if coupling == "cautious":
        seen = replace(seen, speed_share=min(seen.speed_share, SLOWER[task]))
    return seen


@dataclass(frozen=True)
class Without:
    """Perception without a task."""

    whole: Perception
    task: str  # one of `TASKS`
    coupling: Coupling

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the surroundings as the complete perception has them, less the output of the task."""
        return leave_out(self.whole.look(snapshot), self.task, self.coupling)


AMBER, CLOSED = "y", "ryu"  # SUMO's letters
SIGHT_M = 90.0


class TruePerception:
    """Ground truth within `SIGHT_M` of the ego vehicle; one per drive, since parked vehicles are looked up once."""

    def __init__(self, weather: str = "clear") -> None:
        self._share = WEATHER_SPEED[weather]

    def look(self, snapshot: Snapshot) -> Seen:
        """Return all road users, lights, and the speed share of the weather as it is."""
        rows = find_around(snapshot, SIGHT_M)
        boxes, velocity, yaw_rate = read_actors(snapshot, rows)
        path, yaw = predict_motion(boxes, velocity, np.where(boxes.label == "pedestrian", 0.0, yaw_rate))
        closed, amber = read_lights(snapshot)
        return Seen(boxes, velocity, path, yaw, np.zeros((len(rows), len(TIMES_S))), closed, amber, self._share)


def find_around(snapshot: Snapshot, reach_m: float) -> NDArray[np.int64]:
    """Return the rows of the actors within `reach_m` of the ego vehicle, without itself."""
    trace, own = snapshot.trace, snapshot.row(EGO)
    away = np.linalg.norm(trace.position[0, :, :2] - trace.position[0, own, :2], axis=1)
    away[own] = np.inf
    return np.flatnonzero(away <= reach_m)


def read_actors(snapshot: Snapshot, rows: NDArray[np.int64]) -> tuple[Boxes, Array, Array]:
    """Return boxes (labels are categories), velocities (N, 2) [m/s] and yaw rates (N,) [rad/s] of some actors."""
    trace = snapshot.trace
    size = trace.size[rows]
    centre = trace.position[0, rows] + size * np.array((0.0, 0.0, 0.5))
    boxes = Boxes(centre, size, trace.yaw[0, rows], trace.category[rows])
    return boxes, trace.velocity[0, rows, :2], trace.yaw_rate[0, rows]


def read_lights(snapshot: Snapshot) -> tuple[frozenset[str], frozenset[str]]:
    """Return the lights that are not green, and those of them that are yellow."""

    def showing(letters: Collection[str]) -> frozenset[str]:
        return frozenset(snapshot.trace.light[np.isin(snapshot.trace.light_state[0], list(letters))].tolist())

    return showing(CLOSED), showing(AMBER)


FIELD_M = (51.2, 28.8)  # ahead, and to each side: the field of the vehicle's detector, `small`
EYE_M = 1.85  # of its LiDAR above the ground
ACROSS = (0.0, -0.4, 0.4)  # of a road user's extent across the line of sight: where rays end
START_M = 0.6  # from the place to the start of a ray, outside a mast


def share_seen(scene: Scene, place: Array, boxes: Boxes, hidden: int | None = None) -> Array:
    """Return (N,) the share of three rays from a place (3,) to each road user that nothing else is in the way of.

    A ray ends before the road user's own body. `hidden` is the row of an actor that is left out, such as the own one.
    """
    if not len(boxes):
        return np.zeros(0)
    sight = boxes.center - place
    flat = np.maximum(np.hypot(*sight[:, :2].T), 1e-6)
    aside = np.stack((-sight[:, 1], sight[:, 0], np.zeros(len(boxes))), axis=1) / flat[:, None]
    along = np.stack((np.cos(boxes.yaw), np.sin(boxes.yaw)), axis=1)
    cross = np.abs((along * aside[:, :2]).sum(axis=1))
    extent = boxes.size[:, 0] * cross + boxes.size[:, 1] * np.sqrt(np.maximum(1 - cross**2, 0))
    ends = boxes.center[:, None] + np.array(ACROSS)[:, None] * (extent[:, None] * aside)[:, None]  # (N, 3, 3)
    rays = ends - place
    length = np.linalg.norm(rays, axis=2)
    unit = (rays / np.maximum(length, 1e-9)[..., None]).reshape(-1, 3)
    body = np.hypot(*boxes.size[:, :2].T)[:, None] / 2
    far = np.maximum(length - START_M - body, 0.0).ravel()
    starts = place + START_M * unit
    blocked = scene.find_occluded(
        starts.astype(np.float32), unit.astype(np.float32), far.astype(np.float32), hidden=hidden
    )
    return 1 - blocked.reshape(len(boxes), len(ACROSS)).mean(axis=1)
