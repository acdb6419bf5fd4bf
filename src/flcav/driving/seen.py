"""Perceived surroundings of the ego vehicle: their record, ground-truth perception, and ablation of tasks.

All perception tasks end in `Seen`: `objects` in the boxes, `trajectory` in the paths, `signs` in the lights, `weather`
in the speed. World frame: ENU, metres, radians, seconds.

A task is ablated by one of two couplings. In the *bare* one no road user is seen without `objects`, all are assumed to
stand without `trajectory`, no light is known without `signs`, and without `weather` the full limit is driven. In the
*cautious* one the driver knows what is missing: it drives more slowly, and tracks keep their velocity. The difference
between the two shows how much a ranking of tasks depends on this choice.

Ground-truth perception has true positions and velocities. The future of a live world is not known, so that it predicts
paths with constant speed and turn rate as well.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from flcav.driving.lines.lane_keeping import SeenLane
from flcav.geometry import Array, Boxes, heading_vectors, wrap_angle
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot

TIMES_S: Array = np.arange(0.0, 4.01, 0.25)  # (T,) times of the points of predicted paths, from the present on
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
    """The perceived surroundings of the ego vehicle at one instant, in the world frame."""

    boxes: Boxes  # (N,) road users
    velocity: Array  # (N, 2) over ground [m/s]
    path: Array  # (N, T, 2) predicted positions at `TIMES_S` [m]
    yaw: Array  # (N, T) predicted headings [rad]
    spread: Array  # (N, T) standard deviation of the predicted position, along each axis [m]
    closed: frozenset[str]  # entries of `Trace.light` that are perceived as red or yellow
    amber: frozenset[str]  # the yellow ones among them
    speed_share: float = 1.0  # share of the speed limit to drive in the weather
    found_by: str = "the truth"  # source of the boxes, in words
    lane: SeenLane | None = None  # the vehicle's lane as a camera sees it; None: as the map has it


class Perception(Protocol):
    """Interface of a driver's perception: from the world to the perceived surroundings."""

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the perceived surroundings at this instant; called once per decision, in order of time."""
        ...


def predict_motion(boxes: Boxes, velocity: Array, yaw_rate: Array | None = None) -> tuple[Array, Array]:
    """Return paths (N, T, 2) [m] and headings (N, T) [rad] at `TIMES_S` by constant velocity, and turn rate if given.

    `velocity` is (N, 2) [m/s], `yaw_rate` (N,) [rad/s]. Positions are the chords of circular arcs (constant turn rate
    and velocity: Schubert et al., FUSION 2008).
    """
    turn = np.zeros((len(boxes), 1)) if yaw_rate is None else yaw_rate[:, None] * TIMES_S
    half = turn / 2
    speed, course = np.linalg.norm(velocity, axis=1), np.arctan2(velocity[:, 1], velocity[:, 0])
    chord = speed[:, None] * TIMES_S * np.sinc(half / np.pi)
    path = boxes.center[:, None, :2] + chord[..., None] * heading_vectors(course[:, None] + half)
    return path, np.asarray(wrap_angle(boxes.yaw[:, None] + np.broadcast_to(turn, chord.shape)))


Coupling = Literal["bare", "cautious"]

TASKS = ("objects", "trajectory", "signs", "weather")
SLOWER: Mapping[str, float] = {  # share of the limit without a task, in the cautious coupling
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
    """Perception with one task ablated."""

    whole: Perception  # with all tasks
    task: str  # one of `TASKS`
    coupling: Coupling

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the output of the complete perception, without that of the task."""
        return leave_out(self.whole.look(snapshot), self.task, self.coupling)


AMBER, CLOSED = "y", "ryu"  # SUMO's letters
SIGHT_M = 90.0  # range of ground-truth perception


class TruePerception:
    """Ground-truth perception within `SIGHT_M` of the ego vehicle."""

    def __init__(self, weather: str = "clear") -> None:
        self._share = WEATHER_SPEED[weather]

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the true road users, lights, and share of the speed limit for the weather."""
        rows = find_around(snapshot, SIGHT_M)
        boxes, velocity, yaw_rate = read_actors(snapshot, rows)
        path, yaw = predict_motion(boxes, velocity, np.where(boxes.label == "pedestrian", 0.0, yaw_rate))
        closed, amber = read_lights(snapshot)
        return Seen(boxes, velocity, path, yaw, np.zeros((len(rows), len(TIMES_S))), closed, amber, self._share)


def find_around(snapshot: Snapshot, reach_m: float) -> NDArray[np.int64]:
    """Return the rows of the actors within `reach_m` of the ego vehicle, without itself."""
    trace, ego = snapshot.trace, snapshot.row(EGO)
    away = np.linalg.norm(trace.position[0, :, :2] - trace.position[0, ego, :2], axis=1)
    away[ego] = np.inf
    return np.flatnonzero(away <= reach_m)


def read_actors(snapshot: Snapshot, rows: NDArray[np.int64]) -> tuple[Boxes, Array, Array]:
    """Return boxes (labels are categories), velocities (N, 2) [m/s] and yaw rates (N,) [rad/s] of actors by row."""
    trace = snapshot.trace
    size = trace.size[rows]
    centre = trace.position[0, rows] + size * np.array((0.0, 0.0, 0.5))
    boxes = Boxes(centre, size, trace.yaw[0, rows], trace.category[rows])
    return boxes, trace.velocity[0, rows, :2], trace.yaw_rate[0, rows]


def read_lights(snapshot: Snapshot) -> tuple[frozenset[str], frozenset[str]]:
    """Return the true lights that are red or yellow, and the yellow ones among them."""

    def showing(letters: Collection[str]) -> frozenset[str]:
        return frozenset(snapshot.trace.light[np.isin(snapshot.trace.light_state[0], list(letters))].tolist())

    return showing(CLOSED), showing(AMBER)


FIELD_M = (51.2, 28.8)  # ahead, and to each side: the field of the vehicle's detector, `small`
EYE_M = 1.85  # height of its LiDAR above the ground
ACROSS = (0.0, -0.4, 0.4)  # ends of rays, as shares of a road user's extent across the line of sight
START_M = 0.6  # from the place to the start of a ray, so that a sensor's mast does not block it


def share_seen(scene: Scene, place: Array, boxes: Boxes, hidden: int | None = None) -> Array:
    """Return the visibility (N,) of road users from a place (3,) [m]: the share of three rays that reach each of them.

    A ray ends in front of the road user's body. `hidden` is the row of an actor that does not block, such as the ego
    vehicle.
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
