"""Motion controller of the ego vehicle: follows a route, keeps its distance, stops at red, brakes for predicted paths.

The corridor is the strip of the vehicle's width along its route. Predicted footprints of road users that overlap it
are in the way. Distances along it are from the centre of the vehicle's box. A footprint is sampled at `PARTS` points on
each of its long sides; they are closer to each other than the corridor is wide, for vehicles of up to 12 m.

Longitudinal control is the Intelligent Driver Model (Treiber, Hennecke and Helbing, Phys. Rev. E 62, 2000) behind the
nearest of several leaders: road users in the corridor, a stop line, and the place where a predicted path crosses the
corridor at the time at which the vehicle would be there. Standing vehicles are passed (`lines.passing`). Where
more than `EMERGENCY_MPS2` is needed to avoid a collision, it brakes fully. Steering is pure pursuit (Coulter,
CMU-RI-TR-92-01, 1992) of the route, or of the lane as a camera sees it (`lines.lane_keeping`) where it sees so far.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from shapely.geometry.base import BaseGeometry

from flcav.driving.lines.passing import CREEPS_MPS, SLIM_M, ReferenceLine, find_standing, list_lines
from flcav.driving.seen import TIMES_S, Seen
from flcav.geometry import Array, Boxes, heading_vectors, left_vectors, rotate
from flcav.world.commands import Controls
from flcav.world.dynamics.vehicle import BodyBlueprint
from flcav.world.map.roads import Route

PARTS = 6
SPACING_M = 1.0  # between the points of the route that footprints are compared with
BEHIND_M = 6.0  # length of the corridor behind the vehicle
AHEAD_M = 80.0  # and ahead of it


class Occupied(NamedTuple):
    """Intervals of the corridor covered by N footprints at T times; empty where `low` > `high`."""

    low: Array  # (N, T) near end [m] along the route from the vehicle's centre, inf where empty
    high: Array  # (N, T) far end [m], -inf where empty


def find_occupied(
    route: ReferenceLine, along: float, boxes: Boxes, path: Array, yaw: Array, half_width_m: float, margin_m: Array
) -> Occupied:
    """Return the intervals that footprints cover of the corridor of a vehicle which is `along` the route [m].

    `boxes` give the sizes of N road users, `path` (N, T, 2) [m] and `yaw` (N, T) [rad] their poses in the world frame;
    `half_width_m` is half the vehicle's width [m], `margin_m` (N, T) the space kept free around each footprint [m].
    """
    n, times = yaw.shape
    low = np.full((n, times), np.inf)
    high = np.full((n, times), -np.inf)
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
    # A footprint can block the corridor without a sampled point inside, such as a truck wider than the corridor. Then
    # its points lie on both sides of the centre line.
    sides = aside.min(axis=1) * aside.max(axis=1) < 0
    within |= (sides & ~within.any(axis=1))[:, None] & (np.abs(ahead) <= 2 * SPACING_M)
    at = marks[nearest] + ahead
    slack = margin_m[row, instant]
    low[row, instant] = np.where(within, at, np.inf).min(axis=1) - slack
    high[row, instant] = np.where(within, at, -np.inf).max(axis=1) + slack
    return Occupied(low, high)


def find_meeting(occupied: Occupied, at: Array, half_length_m: float) -> NDArray[np.bool_]:
    """Return whether (N, T) a vehicle touches each footprint, with its centre `at` (T,) [m] along the corridor."""
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


GAIN_MPS2 = 2.0  # greatest acceleration
EASE_MPS2 = 2.5  # comfortable deceleration
HEADWAY_S = 1.2
STANDSTILL_M = 2.0  # gap to a standing leader
EMERGENCY_MPS2 = 4.0  # from this need on all brakes are used
ASIDE_MPS2 = 2.5  # greatest lateral acceleration in curves
LINE_M = 4.0  # from the front to a stop line: the signal head at the line stays in the camera's field of view
SAME_WAY = 0.7  # cosine between a road user's course and the route above which it counts as a leader
NEAR_M, AIM_S = 3.5, 0.35  # distance at which the vehicle aims, and its growth with the speed
CURVES_M = np.arange(0.0, 45.0, 3.0)
FARTHEST_GAP_M = 1e3


@dataclass(frozen=True)
class DriverSettings:
    """Settings of a driver: its safety margins, fixed and by the uncertainty of perception."""

    margin_m: float = 0.4  # fixed part of the margin
    sigmas: float = 0.0  # multiple of the standard deviation of predicted positions that is added to it
    most_m: float = 3.0  # upper limit of the margin


DEFAULT = DriverSettings()


@dataclass(frozen=True)
class EgoMotion:
    """Pose and speed of the ego vehicle in the world frame."""

    x: float  # of the box's centre [m]
    y: float  # [m]
    yaw: float  # [rad]
    speed: float  # forward [m/s]
    along: float  # distance along the route [m]


Steered = Literal["route", "lane", "beside"]  # the route, the lane that a camera sees, a line around who stands


@dataclass(frozen=True)
class Decision:
    """Controls of a driver at one step, with the acceleration that they aim at."""

    controls: Controls
    acceleration: float  # target [m/s^2]
    emergency: bool  # whether it brakes fully
    cause: int | str | None = None  # of slowing down: a row of `Seen`, or the name of a light; None on a free road
    steered: Steered = "route"  # what it steers along


Need = tuple[float, int | str | None]  # an acceleration [m/s^2], and its cause as in `Decision`


def decide_controls(
    route: Route,
    own: EgoMotion,
    seen: Seen,
    vehicle: BodyBlueprint,
    settings: DriverSettings = DEFAULT,
    lanes: BaseGeometry | None = None,
) -> Decision:
    """Return the controls for the next step of 0.1 s; a path around standing vehicles has to stay within `lanes`."""
    wanted = find_speed(route, own, seen.speed_share)
    half = vehicle.size[0] / 2
    free = _follow(own.speed, wanted, FARTHEST_GAP_M, wanted)
    needs: list[Need] = [(free, None), _stop_at_light(route, own, seen, half, wanted)]
    margin = np.minimum(settings.margin_m + settings.sigmas * seen.spread, settings.most_m)

    def judge(line: ReferenceLine, kept: Array) -> Need:
        occupied = find_occupied(line, own.along, seen.boxes, seen.path, seen.yaw, vehicle.size[1] / 2, kept)
        return _least([*needs, *_avoid(line, own, seen, occupied, half, wanted)])

    line, (acceleration, cause) = _choose_line(route, own, seen, vehicle, wanted, margin, judge, lanes)
    emergency = acceleration < -EMERGENCY_MPS2
    if emergency:
        acceleration = -vehicle.brake_mps2
    pedal = acceleration / (GAIN_MPS2 * 2 if acceleration > 0 else vehicle.brake_mps2)
    if own.speed < 0.3 and acceleration <= 0.1:
        pedal = -1.0  # stand still
    aim_m = own.along + NEAR_M + AIM_S * own.speed
    steered: Steered = "route" if line is route else "beside"
    if steered == "route" and seen.lane is not None and aim_m <= seen.lane.to_m:
        line, steered = seen.lane, "lane"
    steer = _steer(line, aim_m, own, vehicle)
    throttle, brake = float(np.clip(pedal, 0, 1)), float(np.clip(-pedal, 0, 1))
    return Decision(Controls(throttle=throttle, steer=steer, brake=brake), acceleration, emergency, cause, steered)


def _least(needs: Sequence[Need]) -> Need:
    return min(needs, key=lambda need: need[0])


def _choose_line(
    route: Route,
    ego: EgoMotion,
    seen: Seen,
    vehicle: BodyBlueprint,
    wanted: float,
    margin: Array,
    judge: Callable[[ReferenceLine, Array], Need],
    lanes: BaseGeometry | None,
) -> tuple[ReferenceLine, Need]:
    """Return the line to follow and its need: the route, or a line around a standing vehicle that blocks it.

    `judge` returns the lowest acceleration that is needed on a line, with a margin (N, T) [m] around road users.
    """
    here = judge(route, margin)
    standing = find_standing(seen.velocity, seen.boxes.label)
    if lanes is None or not isinstance(here[1], int) or not standing[here[1]]:
        return route, here
    free = min(_approach_speed(ego.speed, wanted), 0.5)
    if here[0] > free:
        return route, here
    _, left = route.project(ego.x, ego.y, ego.along)
    ways: list[ReferenceLine] = [route, *list_lines(route, ego.along, left, ego.speed, vehicle.size[1], lanes)]
    full = [here, *(judge(line, margin) for line in ways[1:])]
    for line, need in zip(ways, full):
        if need[0] > free:
            return line, need
    slim = np.where(standing[:, None], np.minimum(margin, SLIM_M), margin)
    creeps = _approach_speed(ego.speed, CREEPS_MPS)
    narrow = [judge(line, slim) for line in ways]
    best = max(range(len(ways)), key=lambda i: (min(narrow[i][0], creeps), full[i][0]))
    return ways[best], _least([narrow[best], (max(creeps, full[best][0]), full[best][1])])


def find_speed(route: Route, own: EgoMotion, share: float) -> float:
    """Return the target speed [m/s] for limits and curves ahead; `share` is that of the limit driven in the weather."""
    ahead = own.along + CURVES_M
    turn = np.abs(np.diff(np.unwrap(route.at(np.append(ahead - 1.5, ahead[-1] + 1.5))[:, 2])))
    curve = np.sqrt(ASIDE_MPS2 / np.maximum(turn / np.diff(CURVES_M)[0], 1e-3))
    limits = np.minimum(curve, [route.limit(float(place)) * share for place in ahead])
    return float(np.sqrt(limits**2 + 2 * EASE_MPS2 * 0.8 * CURVES_M).min())


def _follow(speed: float, wanted: float, gap_m: float, ahead_mps: float) -> float:
    """Return the acceleration [m/s^2] of the Intelligent Driver Model at `gap_m` behind a leader of `ahead_mps`."""
    closing = speed * (speed - ahead_mps) / (2 * np.sqrt(GAIN_MPS2 * EASE_MPS2))
    desired = STANDSTILL_M + max(0.0, speed * HEADWAY_S + closing)
    near = (desired / max(gap_m, 0.1)) ** 2
    return float(max(_approach_speed(speed, max(wanted, 0.1)) - GAIN_MPS2 * near, -12.0))


def _approach_speed(speed: float, wanted: float) -> float:
    """Return the acceleration [m/s^2] on a free road; above the wanted speed, it brakes at most comfortably.

    Above the wanted speed it is that of the improved model (Treiber and Kesting, Traffic Flow Dynamics, 2013, 11.3.7).
    """
    if speed <= wanted:
        return GAIN_MPS2 * (1 - (speed / wanted) ** 4)
    return -EASE_MPS2 * (1 - (wanted / speed) ** (4 * GAIN_MPS2 / EASE_MPS2))


def _halt(speed: float, wanted: float, gap_m: float) -> float:
    """Return the acceleration [m/s^2] for a stop after `gap_m` [m]; braking begins at the comfortable deceleration."""
    needed = speed**2 / (2 * max(gap_m, 0.1))
    if needed > EASE_MPS2:
        return -1.1 * needed
    return _follow(speed, wanted, gap_m + STANDSTILL_M, 0.0)


def _stop_at_light(route: Route, ego: EgoMotion, seen: Seen, half_m: float, wanted: float) -> Need:
    """Return the acceleration for the next closed light; a yellow light that is too near to stop at is passed."""
    for stop, link in route.stops:
        gap = stop - LINE_M - ego.along - half_m
        if gap < -LINE_M + 0.5 or link not in seen.closed:
            continue
        needed = ego.speed**2 / (2 * max(gap, 0.1))
        if needed > (EMERGENCY_MPS2 - 0.5 if link in seen.amber else 8.0):
            continue
        return _halt(ego.speed, wanted, gap), link
    return np.inf, None


def _avoid(
    route: ReferenceLine, ego: EgoMotion, seen: Seen, occupied: Occupied, half_m: float, wanted: float
) -> list[Need]:
    """Return the acceleration for each road user in the corridor, now or on its predicted path."""
    present = np.isfinite(occupied.low).any(axis=1)
    if not present.any():
        return []
    go = _cover(ego.speed, wanted, GAIN_MPS2)
    keep = ego.speed * TIMES_S
    meets = find_meeting(occupied, go, half_m) | find_meeting(occupied, keep, half_m)
    needs: list[Need] = []
    for row in np.flatnonzero(present).tolist():
        low = occupied.low[row]
        nearest = float(np.min(low))
        place = ego.along + (float(low[0]) if np.isfinite(low[0]) else nearest)
        along_mps = float(seen.velocity[row] @ heading_vectors(route.at(place)[2]))
        same_way = along_mps > SAME_WAY * float(np.hypot(*seen.velocity[row])) and along_mps > 0.5
        if np.isfinite(low[0]) and occupied.high[row, 0] > 0:  # now in the corridor, and not behind
            if occupied.low[row, 0] > -half_m:
                needs.append((_follow(ego.speed, wanted, float(low[0]) - half_m, max(along_mps, 0.0)), row))
            continue
        if not meets[row].any():
            continue
        first = int(np.argmax(meets[row]))
        if same_way:
            gap = float(low[first]) - along_mps * float(TIMES_S[first]) - half_m
            needs.append((_follow(ego.speed, wanted, max(gap, 1.0), along_mps), row))
            continue
        gap = float(np.min(low[np.isfinite(low)])) - half_m
        if gap > 0:  # otherwise it is in the way already, and leaves it
            needs.append((_halt(ego.speed, wanted, gap - 1.0), row))
    return needs


def _cover(speed: float, wanted: float, gain: float) -> Array:
    """Return the distances (T,) [m] driven by `TIMES_S` when accelerating to the wanted speed."""
    rise = max((wanted - speed) / gain, 0.0)
    early = np.minimum(TIMES_S, rise)
    return speed * early + gain * early**2 / 2 + max(wanted, speed) * (TIMES_S - early)


def _steer(line: ReferenceLine, aim_m: float, ego: EgoMotion, vehicle: BodyBlueprint) -> float:
    """Return the steering by pure pursuit of a line's place `aim_m` [m], as a share in [-1, 1]; left is positive."""
    aim_x, aim_y, _ = line.at(aim_m)
    ahead, left = rotate(aim_x - ego.x, aim_y - ego.y, -ego.yaw)
    angle = np.arctan(2 * vehicle.wheelbase_m * left / (ahead**2 + left**2))
    return float(np.clip(angle / vehicle.steer_limit_rad, -1, 1))
