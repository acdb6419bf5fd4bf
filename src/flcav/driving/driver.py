"""A driver: follows a route, keeps its distance, stops at red, and brakes for what is predicted to be in its way.

The corridor of the route tells where and when predicted footprints are in the way. Distances along it are from the
vehicle's middle. A footprint is taken for `PARTS` points along each of its sides, which are nearer to each other than
the corridor is wide for vehicles of up to 12 m.

Longitudinal control is the Intelligent Driver Model (Treiber, Hennecke and Helbing, Phys. Rev. E 62, 2000) behind the
nearest of several leaders: road users in the corridor, a stop line, and the place where a predicted path crosses the
corridor at the time at which the vehicle would be there. Around vehicles that stand it looks for a way
(`passing`), if its settings allow it. Where only more than `EMERGENCY_MPS2` avoids that, it brakes
with all it has. Steering is pure pursuit (Coulter, CMU-RI-TR-92-01, 1992).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from shapely.geometry.base import BaseGeometry

from flcav.driving.passing import CREEPS_MPS, SLIM_M, ReferenceLine, find_standing, list_lines
from flcav.driving.seen import TIMES_S, Seen
from flcav.geometry import Array, Boxes, heading_vectors, left_vectors, rotate
from flcav.storage.records import WHERE_TRUE
from flcav.world.commands import Controls
from flcav.world.dynamics.vehicle import BodyBlueprint
from flcav.world.map.roads import Route

PARTS = 6
SPACING_M = 1.0  # of the points of the route that a place is compared with
BEHIND_M = 6.0  # how far back, and
AHEAD_M = 80.0  # ahead the corridor goes


class Occupied(NamedTuple):
    """The part of the corridor that each of N footprints covers at each of T times; empty where `low` > `high`."""

    low: Array  # (N, T) nearest distance along the route [m], inf where it covers none
    high: Array  # (N, T) farthest, -inf where it covers none


def find_occupied(
    route: ReferenceLine, along: float, boxes: Boxes, path: Array, yaw: Array, half_width_m: float, margin_m: Array
) -> Occupied:
    """Return what footprints cover of the corridor of a vehicle that is `along` the route [m].

    `boxes` give the sizes of N road users, `path` (N, T, 2) and `yaw` (N, T) their poses; `half_width_m` is that of
    the vehicle, `margin_m` (N, T) what is kept free on all sides of each footprint.
    """
    n, times = yaw.shape
    low, high = np.full((n, times), np.inf), np.full((n, times), -np.inf)
    marks = np.arange(-BEHIND_M, AHEAD_M, SPACING_M)
    points = route.at(along + marks)
    heading, left = heading_vectors(points[:, 2]), left_vectors(points[:, 2])
    reach = np.hypot(*boxes.size[:, :2].T)[:, None] / 2 + half_width_m + margin_m + SPACING_M
    row, instant = _find_near(path, points[:, :2], reach)
    if not len(row):
        return Occupied(low, high)
    shares = np.linspace(-0.5, 0.5, PARTS)
    unit = np.concatenate([np.c_[shares, np.full(PARTS, side)] for side in (-0.5, 0.5)])
    offset = unit[None] * boxes.size[row, None, :2]
    turn = yaw[row, instant]
    corner = path[row, instant][:, None] + offset[..., :1] * heading_vectors(turn)[:, None]
    corner = corner + offset[..., 1:] * left_vectors(turn)[:, None]  # (M, 2 PARTS, 2)
    nearest = cdist(corner.reshape(-1, 2), points[:, :2]).argmin(axis=1).reshape(corner.shape[:2])
    gap = corner - points[nearest, :2]
    ahead = (gap * heading[nearest]).sum(axis=2)
    aside = (gap * left[nearest]).sum(axis=2)
    within = (np.abs(aside) <= half_width_m + margin_m[row, instant][:, None]) & (np.abs(ahead) <= 2 * SPACING_M)
    sides = aside.min(axis=1) * aside.max(axis=1) < 0  # it reaches across the corridor's middle
    within |= (sides & ~within.any(axis=1))[:, None] & (np.abs(ahead) <= 2 * SPACING_M)
    at = marks[nearest] + ahead
    slack = margin_m[row, instant]
    low[row, instant] = np.where(within, at, np.inf).min(axis=1) - slack
    high[row, instant] = np.where(within, at, -np.inf).max(axis=1) + slack
    return Occupied(low, high)


def find_meeting(occupied: Occupied, at: Array, half_length_m: float) -> NDArray[np.bool_]:
    """Return (N, T) whether a vehicle whose middle is `at` (T,) [m] along the corridor then touches each footprint."""
    return (occupied.low <= at + half_length_m) & (occupied.high >= at - half_length_m)


def _find_near(path: Array, points: Array, reach: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and times of the places (N, T, 2) that are within `reach` (N, T) of the route's `points`."""
    low, high = points.min(axis=0), points.max(axis=0)
    about = (path >= low - reach[..., None]) & (path <= high + reach[..., None])
    row, instant = np.nonzero(about.all(axis=2))
    if len(row):
        apart = cdist(path[row, instant], points, "chebyshev").min(axis=1)
        near = apart < reach[row, instant]
        row, instant = row[near], instant[near]
    return row, instant


GAIN_MPS2, EASE_MPS2 = 2.0, 2.5  # greatest acceleration, comfortable deceleration
HEADWAY_S, STANDSTILL_M = 1.2, 2.0
EMERGENCY_MPS2 = 4.0  # from this need on all brakes are used
ASIDE_MPS2 = 2.5  # greatest lateral acceleration in curves
LINE_M = 4.0  # from the front to a stop line: a head beside it stays in the picture of a camera
SAME_WAY = 0.7  # cosine between a road user's course and the route from which it is a leader
CURVES_M = np.arange(0.0, 45.0, 3.0)
FARTHEST_GAP_M = 1e3


@dataclass(frozen=True)
class DriverSettings:
    """Safety margins of a driver: a fixed distance, and a multiple of its perception's uncertainty."""

    margin_m: float = 0.4
    sigmas: float = 0.0  # multiple of the standard deviation of predicted positions
    most_m: float = 3.0  # the margin is never more
    passes: Annotated[bool, WHERE_TRUE] = False  # looks for a way around vehicles that stand


DEFAULT = DriverSettings()


@dataclass(frozen=True)
class EgoMotion:
    """Pose and speed of the ego vehicle, by its own navigation."""

    x: float  # of the box's middle [m]
    y: float
    yaw: float  # [rad]
    speed: float  # [m/s]
    along: float  # the route [m]


@dataclass(frozen=True)
class Decision:
    """Controls of a driver, with the acceleration that they are for."""

    controls: Controls
    acceleration: float  # that it wants [m/s^2]
    emergency: bool
    cause: int | str | None = None  # what it slows for: the row of `Seen`, or the light; None on a free road


Need = tuple[float, int | str | None]  # an acceleration [m/s^2], and its cause as in `Decision`


def decide_controls(
    route: Route,
    own: EgoMotion,
    seen: Seen,
    vehicle: BodyBlueprint,
    settings: DriverSettings = DEFAULT,
    lanes: BaseGeometry | None = None,
) -> Decision:
    """Return the controls for the next tenth of a second; a way around is looked for in the area of the `lanes`."""
    wanted = find_speed(route, own, seen.speed_share)
    half = vehicle.size[0] / 2
    free = _follow(own.speed, wanted, FARTHEST_GAP_M, wanted)
    needs: list[Need] = [(free, None), _stop_at_light(route, own, seen, half, wanted)]
    margin = np.minimum(settings.margin_m + settings.sigmas * seen.spread, settings.most_m)

    def judge(line: ReferenceLine, kept: Array) -> Need:
        occupied = find_occupied(line, own.along, seen.boxes, seen.path, seen.yaw, vehicle.size[1] / 2, kept)
        return _least([*needs, *_avoid(line, own, seen, occupied, half, wanted)])

    line, (acceleration, cause) = _choose_line(route, own, seen, vehicle, wanted, margin, judge, settings, lanes)
    emergency = acceleration < -EMERGENCY_MPS2
    if emergency:
        acceleration = -vehicle.brake_mps2
    pedal = acceleration / (GAIN_MPS2 * 2 if acceleration > 0 else vehicle.brake_mps2)
    if own.speed < 0.3 and acceleration <= 0.1:
        pedal = -1.0  # stand still
    steer = _steer(line, own, vehicle)
    throttle, brake = float(np.clip(pedal, 0, 1)), float(np.clip(-pedal, 0, 1))
    return Decision(Controls(throttle=throttle, steer=steer, brake=brake), acceleration, emergency, cause)


def _least(needs: Sequence[Need]) -> Need:
    return min(needs, key=lambda need: need[0])


def _choose_line(
    route: Route,
    own: EgoMotion,
    seen: Seen,
    vehicle: BodyBlueprint,
    wanted: float,
    margin: Array,
    judge: Callable[[ReferenceLine, Array], Need],
    settings: DriverSettings,
    lanes: BaseGeometry | None,
) -> tuple[ReferenceLine, Need]:
    """Return the route, or the line beside it on which the vehicle gets on best past who stands, and its need.

    `judge` returns the least need on a line with a margin (N, T) around the road users.
    """
    here = judge(route, margin)
    standing = find_standing(seen.velocity, seen.boxes.label)
    if not settings.passes or lanes is None or not isinstance(here[1], int) or not standing[here[1]]:
        return route, here
    free = min(_approach_speed(own.speed, wanted), 0.5)
    if here[0] > free:
        return route, here
    _, left = route.project(own.x, own.y, own.along)
    ways: list[ReferenceLine] = [route, *list_lines(route, own.along, left, own.speed, vehicle.size[1], lanes)]
    full = [here, *(judge(line, margin) for line in ways[1:])]
    for line, need in zip(ways, full):
        if need[0] > free:
            return line, need
    slim = np.where(standing[:, None], np.minimum(margin, SLIM_M), margin)
    creeps = _approach_speed(own.speed, CREEPS_MPS)
    narrow = [judge(line, slim) for line in ways]
    best = max(range(len(ways)), key=lambda i: (min(narrow[i][0], creeps), full[i][0]))
    return ways[best], _least([narrow[best], (max(creeps, full[best][0]), full[best][1])])


def find_speed(route: Route, own: EgoMotion, share: float) -> float:
    """Return the speed [m/s] that limits, curves ahead and the weather allow."""
    ahead = own.along + CURVES_M
    turn = np.abs(np.diff(np.unwrap(route.at(np.append(ahead - 1.5, ahead[-1] + 1.5))[:, 2])))
    curve = np.sqrt(ASIDE_MPS2 / np.maximum(turn / np.diff(CURVES_M)[0], 1e-3))
    limits = np.minimum(curve, [route.limit(float(each)) * share for each in ahead])
    return float(np.sqrt(limits**2 + 2 * EASE_MPS2 * 0.8 * CURVES_M).min())


def _follow(speed: float, wanted: float, gap_m: float, ahead_mps: float) -> float:
    """Return the acceleration [m/s^2] of the Intelligent Driver Model at `gap_m` behind a leader of `ahead_mps`."""
    closing = speed * (speed - ahead_mps) / (2 * np.sqrt(GAIN_MPS2 * EASE_MPS2))
    desired = STANDSTILL_M + max(0.0, speed * HEADWAY_S + closing)
    near = (desired / max(gap_m, 0.1)) ** 2
    return float(max(_approach_speed(speed, max(wanted, 0.1)) - GAIN_MPS2 * near, -12.0))


def _approach_speed(speed: float, wanted: float) -> float:
    """Return the acceleration [m/s^2] on a free road: slower than comfortable braking where it is too fast.

    Above the wanted speed it is that of the improved model (Treiber and Kesting, Traffic Flow Dynamics, 2013, 11.3.7).
    """
    if speed <= wanted:
        return GAIN_MPS2 * (1 - (speed / wanted) ** 4)
    return -EASE_MPS2 * (1 - (wanted / speed) ** (4 * GAIN_MPS2 / EASE_MPS2))


def _halt(speed: float, wanted: float, gap_m: float) -> float:
    """Return the acceleration [m/s^2] with which to halt `gap_m` further on: none before it has to be comfortable."""
    needed = speed**2 / (2 * max(gap_m, 0.1))
    if needed > EASE_MPS2:
        return -1.1 * needed
    return _follow(speed, wanted, gap_m + STANDSTILL_M, 0.0)


def _stop_at_light(route: Route, own: EgoMotion, seen: Seen, half_m: float, wanted: float) -> Need:
    """Return the acceleration for the next light: none at a yellow one that is too near to stop for."""
    for stop, link in route.stops:
        gap = stop - LINE_M - own.along - half_m
        if gap < -LINE_M + 0.5 or link not in seen.closed:
            continue
        needed = own.speed**2 / (2 * max(gap, 0.1))
        if needed > (EMERGENCY_MPS2 - 0.5 if link in seen.amber else 8.0):
            continue
        return _halt(own.speed, wanted, gap), link
    return np.inf, None


def _avoid(
    route: ReferenceLine, own: EgoMotion, seen: Seen, occupied: Occupied, half_m: float, wanted: float
) -> list[Need]:
    """Return the acceleration for each road user that is, or is going to be, in the way."""
    present = np.isfinite(occupied.low).any(axis=1)
    if not present.any():
        return []
    go = _cover(own.speed, wanted, GAIN_MPS2)
    keep = own.speed * TIMES_S
    meets = find_meeting(occupied, go, half_m) | find_meeting(occupied, keep, half_m)
    needs: list[Need] = []
    for row in np.flatnonzero(present).tolist():
        low = occupied.low[row]
        nearest = float(np.min(low))
        place = own.along + (float(low[0]) if np.isfinite(low[0]) else nearest)
        along_mps = float(seen.velocity[row] @ heading_vectors(route.at(place)[2]))
        same_way = along_mps > SAME_WAY * float(np.hypot(*seen.velocity[row])) and along_mps > 0.5
        if np.isfinite(low[0]) and occupied.high[row, 0] > 0:  # now in the corridor, and not behind
            if occupied.low[row, 0] > -half_m:
                needs.append((_follow(own.speed, wanted, float(low[0]) - half_m, max(along_mps, 0.0)), row))
            continue
        if not meets[row].any():
            continue
        first = int(np.argmax(meets[row]))
        if same_way:
            gap = float(low[first]) - along_mps * float(TIMES_S[first]) - half_m
            needs.append((_follow(own.speed, wanted, max(gap, 1.0), along_mps), row))
            continue
        gap = float(np.min(low[np.isfinite(low)])) - half_m
        if gap > 0:  # otherwise it is in the way already, and leaves it
            needs.append((_halt(own.speed, wanted, gap - 1.0), row))
    return needs


def _cover(speed: float, wanted: float, gain: float) -> Array:
    """Return the distances (T,) [m] driven by `TIMES_S` when accelerating to the wanted speed."""
    rise = max((wanted - speed) / gain, 0.0)
    early = np.minimum(TIMES_S, rise)
    return speed * early + gain * early**2 / 2 + max(wanted, speed) * (TIMES_S - early)


def _steer(route: ReferenceLine, own: EgoMotion, vehicle: BodyBlueprint) -> float:
    """Return the share of the greatest steering angle (pure pursuit)."""
    aim_x, aim_y, _ = route.at(own.along + 3.5 + 0.35 * own.speed)
    ahead, left = rotate(aim_x - own.x, aim_y - own.y, -own.yaw)
    angle = np.arctan(2 * vehicle.wheelbase_m * left / (ahead**2 + left**2))
    return float(np.clip(angle / vehicle.steer_limit_rad, -1, 1))
