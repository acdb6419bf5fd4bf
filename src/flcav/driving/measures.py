"""Measures of a drive: time to collision, hard braking, progress, standstill, collisions, and the driving score.

A collision is at fault unless the ego vehicle stood, or was hit from behind by something faster (the follower keeps the
distance: Shalev-Shwartz et al., "On a formal model of safe and scalable self-driving cars", 2017, rule 1). The driving
score is progress times a factor for every infraction: those of nuPlan's closed-loop score for collisions at fault
(Caesar et al., 2021), and of CARLA's leaderboard for red lights.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flcav.driving.driver import EgoMotion, find_meeting, find_occupied
from flcav.driving.seen import EGO, TIMES_S, Seen, find_around, read_lights
from flcav.geometry import heading_vectors
from flcav.interface.wording import plural
from flcav.storage.records import Record
from flcav.world.map.roads import Route
from flcav.world.snapshot import Collision, Snapshot

HARD_MPS2 = 4.0  # deceleration of a hard brake
STANDS_MPS = 0.3  # below it the vehicle stands
STOOD_S = 1.0  # a shorter standstill is not reported
FALSE_M = 3.0  # a box farther than this from every actor is a false positive
NEAR_S = 1.5  # critical time to collision
PENALTY: Mapping[str, float] = {"pedestrian": 0.0, "vehicle": 0.0, "obstacle": 0.5, "red light": 0.7}


@dataclass(frozen=True)
class Hit(Record):
    """A collision of the ego vehicle: its time, the other body, and whether the ego vehicle is at fault."""

    time_s: float
    other: str
    kind: str  # a key of `PENALTY`
    speed: float  # of the ego vehicle before the collision [m/s]
    at_fault: bool


@dataclass(frozen=True)
class DriveResult(Record):
    """The measures of one drive."""

    scenario: str
    seed: int
    time_s: float
    progress: float  # driven share of the distance that the speed limit allows in the time, 0 to 1
    mean_speed: float  # [m/s]
    least_ttc_s: float  # least time to collision, at most the last of `TIMES_S`
    near_share: float  # share of the time with a time to collision below `NEAR_S`
    hard_brakes: int  # number of decelerations above `HARD_MPS2`
    red_lights: int  # stop lines passed at red
    hits: tuple[Hit, ...]
    score: float  # the driving score, 0 to 1: progress times all `penalties`
    penalties: Mapping[str, float] = field(default_factory=dict)  # factor of each infraction that happened
    stood_s: Mapping[str, float] = field(default_factory=dict)  # standstill [s] by its cause, longest first

    def line(self) -> str:
        """Return the measures in words, with the score and its factors."""
        hits = "".join(f", {'hits' if hit.at_fault else 'is hit by'} {hit.other}" for hit in self.hits)
        reds = f", {plural(self.red_lights, 'red light')} passed" if self.red_lights else ""
        return (
            f"{self.scenario}, seed {self.seed}: progress {self.progress:.2f}, {self.mean_speed:.1f} m/s, least time "
            f"to collision {self.least_ttc_s:.2f} s, {plural(self.hard_brakes, 'hard brake')}{reds}{hits}, score "
            f"{self.describe_score()}{describe_standing(self.stood_s, self.time_s)}"
        )

    def describe_score(self) -> str:
        """Return the score in words, with the factors that it is made of."""
        made = "".join(f" x {factor:.2g} ({name})" for name, factor in self.penalties.items())
        return f"{self.score:.2f}" + (f" = {self.progress:.2f}{made}" if made else "")

    @property
    def stood_in_all_s(self) -> float:
        """Return the total time at standstill [s]."""
        return round(sum(self.stood_s.values()), 1)

    @property
    def faults(self) -> int:
        """Return the number of collisions at fault."""
        return sum(hit.at_fault for hit in self.hits)


def list_penalties(hits: Sequence[Hit], red_lights: int) -> dict[str, float]:
    """Return the penalty factors by infraction: collisions at fault, and red lights passed."""
    kinds = [hit.kind for hit in hits if hit.at_fault] + ["red light"] * red_lights
    count = {kind: kinds.count(kind) for kind in PENALTY if kind in kinds}
    return {plural(number, kind): PENALTY[kind] ** number for kind, number in count.items()}


def score_drive(progress: float, hits: Sequence[Hit], red_lights: int) -> float:
    """Return the driving score: progress times the penalties of collisions at fault and of red lights."""
    return progress * float(np.prod(list(list_penalties(hits, red_lights).values())))


def describe_standing(stood_s: Mapping[str, float], time_s: float) -> str:
    """Return in words how long a vehicle stood within `time_s` [s], and the causes; "" for less than `STOOD_S`."""
    if sum(stood_s.values()) < STOOD_S:
        return ""
    before = ", ".join(f"{duration:.1f} s before {cause}" for cause, duration in stood_s.items())
    return f"; stood {sum(stood_s.values()):.1f} of {time_s:.1f} s: {before}"


def name_cause(cause: int | str | None, seen: Seen, snapshot: Snapshot) -> str:
    """Return the cause of slowing down (`Decision.cause`) in words, checked against the true state of the world.

    A box without an actor within `FALSE_M` is a false positive.
    """
    if cause is None:
        return "an open road"
    if isinstance(cause, str):
        return "a red light" if cause in read_lights(snapshot)[0] else "a green light taken for red"
    at = seen.boxes.center[cause, :2]
    rows = find_around(snapshot, np.inf)
    away = np.hypot(*(snapshot.trace.position[0, rows, :2] - at).T)
    if not len(rows) or away.min() > FALSE_M:
        return f"a false {str(seen.boxes.label[cause]).lower()} of {seen.found_by}"
    nearest = rows[int(away.argmin())]
    parked = "parked " if str(snapshot.trace.actor[nearest]).startswith("parked") else ""
    return f"a {parked}{snapshot.trace.category[nearest]}"


def describe_drives(drives: Sequence[DriveResult]) -> str:
    """Return the infractions and standstills of all drives in words."""
    faults = sum(drive.faults for drive in drives)
    hits = sum(len(drive.hits) for drive in drives)
    reds = sum(drive.red_lights for drive in drives)
    hard = sum(drive.hard_brakes for drive in drives)
    stood: dict[str, float] = {}
    for drive in drives:
        for cause, duration in drive.stood_s.items():
            stood[cause] = stood.get(cause, 0.0) + duration
    longest = dict(sorted(stood.items(), key=lambda item: -item[1]))
    return (
        f"{plural(len(drives), 'drive')}: {plural(faults, 'collision')} at fault, {plural(hits - faults, 'other')}, "
        f"{plural(reds, 'red light')} passed, {plural(hard, 'hard brake')}"
        f"{describe_standing(longest, sum(drive.time_s for drive in drives))}"
    )


def measure_ttc(route: Route, own: EgoMotion, truth: Seen, size: tuple[float, float]) -> float:
    """Return the time to collision [s] by the true states, if everybody keeps their motion; at most the horizon.

    The ego vehicle, of length and width `size` [m], keeps its speed along the route. `truth` has the paths of others.
    """
    if own.speed < STANDS_MPS:
        return float(TIMES_S[-1])
    margin = np.zeros(truth.yaw.shape)
    occupied = find_occupied(route, own.along, truth.boxes, truth.path, truth.yaw, size[1] / 2, margin)
    first = find_meeting(occupied, own.speed * TIMES_S, size[0] / 2).any(axis=0)
    return float(TIMES_S[int(np.argmax(first))]) if first.any() else float(TIMES_S[-1])


def judge_collision(collision: Collision, before: Snapshot, categories: Mapping[str, str], time_s: float) -> Hit:
    """Return the record of a collision of the ego vehicle at `time_s` [s]; `before` is the snapshot one step earlier.

    `categories` has the category of each actor by name; a body without one is an obstacle.
    """
    other = collision.other if collision.name == EGO else collision.name
    trace, ego = before.trace, before.row(EGO)
    yaw = float(trace.yaw[0, ego])
    speed = float(np.hypot(*trace.velocity[0, ego, :2]))
    category = categories.get(other)
    kind = "obstacle" if category in (None, "prop") else "pedestrian" if category == "pedestrian" else "vehicle"
    struck = False
    rows = np.flatnonzero(trace.actor == other)
    if len(rows):
        ahead = heading_vectors(yaw)
        length = trace.size[ego, 0]
        at = np.array(collision.point) - trace.position[0, ego, :2]
        at_rear = (
            float(at @ ahead) < -length / 2 + 0.6
            or float(trace.position[0, rows[0], :2] @ ahead) < float(trace.position[0, ego, :2] @ ahead) - length / 2
        )
        faster = float((trace.velocity[0, rows[0], :2] - trace.velocity[0, ego, :2]) @ ahead) > 0
        struck = at_rear and faster
    return Hit(time_s, other, kind, speed, not (speed < STANDS_MPS or struck))
