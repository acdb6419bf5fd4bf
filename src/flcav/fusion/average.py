"""The road average: boxes of road sensors and vehicles over a window of spins, averaged by their uncertainty.

An agent reports boxes of a spin in the world frame; the uncertainty of its pose, as its navigation states it, is added
to their variances. Boxes are associated with objects spin by spin: an object moves at constant velocity, a box belongs
to it within a gate of Mahalanobis distance, and the Hungarian method resolves conflicts. The errors of one agent's
boxes of an object in several spins are correlated (its pose, its clock), so that these are joined by covariance
intersection, which stays consistent whatever the correlation (Julier and Uhlmann, ACC 1997), with the weights of
Niehsen, "Information fusion based on fast covariance intersection filtering", FUSION 2002: in proportion to 1 / trace.
Boxes of different agents are joined as independent, by inverse variance.

Poses of vehicles are either the true ones with random errors (`NavigationErrors`), or estimated from the measurements
of the vehicle's GNSS receiver and IMU (`flcav.fusion.inertial`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from flcav.arrays import Array, Ints
from flcav.config import Config
from flcav.geometry import Boxes, pose, wrap_angle

YAW = 6  # column of a box and of its variance
GATE = 18.4  # largest squared Mahalanobis distance in x, y of a box from its object: 99.99 % of chi-squared, 2 dof
FAR = 1e6  # cost of a pair outside the gate
SPEED_MPS = 8.0  # standard deviation of an object's velocity, before it is observed
LEAST_VARIANCE = np.array((0.05, 0.05, 0.05, 0.1, 0.05, 0.05, 0.03)) ** 2  # of a box, whatever its detector predicts
UNKNOWN_VARIANCE = np.array((0.3, 0.3, 0.2, 0.4, 0.15, 0.15, 0.2)) ** 2  # of boxes without a predicted one


@dataclass(frozen=True)
class BoxReport:
    """Boxes that one agent sends of one spin, in the world frame."""

    agent: str  # its name
    time_s: float  # by the agent's clock
    boxes: Boxes  # world frame


@dataclass(frozen=True)
class RoadAverage:
    """The K objects of a window of spins."""

    boxes: Boxes  # (K,) world frame, at the time asked for, with scores and variances
    velocity: Array  # (K, 2) along x and y of the world [m/s]
    agents: Ints  # (K,) number of agents that saw the object
    member: tuple[Ints, ...]  # for each `BoxReport` the object of each of its boxes


def average_boxes(reports: Sequence[BoxReport], at_s: float) -> RoadAverage:
    """Return the objects at `at_s` [s] that agents report in a window of spins, world frame.

    An agent's score of an object is the mean over all its spins, zero where it does not report the object; the average
    has the score 1 - product of (1 - score) over the agents: the probability that at least one is right.
    """
    reports = list(reports)
    member = _associate(reports, at_s)
    flat = np.concatenate([np.zeros(0, dtype=np.int64), *member])
    count = int(flat.max(initial=-1)) + 1
    names = sorted({report.agent for report in reports})
    spins = np.array([sum(report.agent == name for report in reports) for name in names], dtype=np.float64)
    lengths = [len(report.boxes) for report in reports]
    agent = np.repeat([names.index(report.agent) for report in reports], lengths).astype(np.int64)
    since = np.repeat([report.time_s - at_s for report in reports], lengths)
    rows = np.concatenate([np.zeros((0, 7)), *(report.boxes.array() for report in reports)])
    variance = np.concatenate([np.zeros((0, 7)), *(variance_of(report.boxes) for report in reports)])
    score = np.concatenate([np.zeros(0), *(_scores(report.boxes) for report in reports)])
    label = np.concatenate([np.zeros(0, dtype=np.str_), *(report.boxes.label for report in reports)])

    lines = _Lines(count)
    lines.add(flat, rows[:, :2], variance[:, :2], since)
    velocity = lines.solve(count)[1]
    rows[:, :2] -= velocity[flat] * since[:, None]
    # A box may face either way: headings are averaged as deviations, modulo half a turn, from the mean axis.
    axis = _mean_heading(flat, rows[:, YAW], variance[:, YAW], count)
    rows[:, YAW] = (rows[:, YAW] - axis[flat] + np.pi / 2) % np.pi - np.pi / 2

    # Covariance intersection over the spins of each agent, then inverse variance over the agents.
    pair, row = np.unique(flat * max(len(names), 1) + agent, return_inverse=True)
    mean, information = _intersect(row, rows, variance, len(pair))
    seen_by = pair % max(len(names), 1)
    owner = pair // max(len(names), 1)
    total = _sums(owner, information, count)
    array = _sums(owner, information * mean, count) / total
    array[:, YAW] = wrap_angle(array[:, YAW] + axis)
    pair_score = np.bincount(row, score, len(pair)) / spins[seen_by] if len(pair) else np.zeros(0)
    missed = np.exp(np.bincount(owner, np.log1p(-np.minimum(pair_score, 1 - 1e-9)), count)) if count else np.zeros(0)
    first = np.unique(flat, return_index=True)[1]
    boxes = Boxes(array[:, :3], array[:, 3:6], array[:, YAW], label[first], 1 - missed, 1 / total)
    return RoadAverage(boxes, velocity, np.bincount(owner, minlength=count), member)


def variance_of(boxes: Boxes) -> Array:
    """Return the variances (N, 7) [m^2, rad^2] of boxes, at least `LEAST_VARIANCE`; `UNKNOWN_VARIANCE` if not known."""
    known = np.tile(UNKNOWN_VARIANCE, (len(boxes), 1)) if boxes.variance is None else boxes.variance
    return np.maximum(known, LEAST_VARIANCE)


class _Lines:
    """Weighted least-squares fits x, y = position + velocity t of objects, with a prior of zero velocity."""

    def __init__(self, most: int) -> None:
        self._sums = np.zeros((5, most, 2))  # w, w t, w t^2, w x, w x t

    def add(self, row: Ints, xy: Array, variance: Array, t: Array | float) -> None:
        """Add boxes (N,) of the objects `row`, with x, y [m] and their variances (N, 2) [m^2], seen at `t` [s]."""
        weight = 1 / variance
        t = np.broadcast_to(np.reshape(t, (-1, 1)), xy.shape)
        for number, value in enumerate((weight, weight * t, weight * t * t, weight * xy, weight * xy * t)):
            np.add.at(self._sums[number], row, value)

    def solve(self, count: int) -> tuple[Array, Array, Array]:
        """Return position (count, 2) [m], velocity (count, 2) [m/s], and their (co)variances (3, count, 2)."""
        # In the order position, position with velocity, velocity; each axis is independent.
        w, wt, wtt, wx, wxt = self._sums[:, :count]
        wtt = wtt + 1 / SPEED_MPS**2
        det = w * wtt - wt**2
        return (wtt * wx - wt * wxt) / det, (w * wxt - wt * wx) / det, np.stack((wtt, -wt, w)) / det


def _associate(reports: Sequence[BoxReport], at_s: float) -> tuple[Ints, ...]:
    """Return for each `BoxReport` the number of each of its boxes' object, from 0."""
    most = sum(len(report.boxes) for report in reports)
    lines, labels, count = _Lines(most), np.zeros(most, dtype=np.int64), 0
    known: dict[str, int] = {}
    member: dict[int, Ints] = {}
    for number in sorted(range(len(reports)), key=lambda i: reports[i].time_s):
        boxes = reports[number].boxes
        t = reports[number].time_s - at_s
        xy = boxes.center[:, :2]
        variance = variance_of(boxes)[:, :2]
        label = np.array([known.setdefault(str(name), len(known)) for name in boxes.label], dtype=np.int64)
        assigned = np.full(len(boxes), -1)
        if count and len(boxes):
            place, velocity, (place_variance, covariance, speed_variance) = lines.solve(count)
            predicted = (place_variance + 2 * t * covariance + t * t * speed_variance)[None] + variance[:, None]
            square = ((xy[:, None] - (place + velocity * t)[None]) ** 2 / predicted).sum(axis=2)
            fits = (square <= GATE) & (label[:, None] == labels[None, :count])
            cost = np.where(fits, square + np.log(predicted.prod(axis=2)), FAR)
            some, to = linear_sum_assignment(cost)
            paired = fits[some, to]
            assigned[some[paired]] = to[paired]
        new = np.flatnonzero(assigned < 0)
        assigned[new] = count + np.arange(len(new))
        labels[assigned[new]] = label[new]
        count += len(new)
        lines.add(assigned, xy, variance, t)
        member[number] = assigned
    return tuple(member[number] for number in range(len(reports)))


def _intersect(row: Ints, mean: Array, variance: Array, count: int) -> tuple[Array, Array]:
    """Return mean (count, 7) and information (count, 7) of the covariance intersection of boxes of the same `row`.

    mean, variance: (N, 7). With weights u_i = (1 / tr_i) / sum (1 / tr_j): information sum u_i / P_i, and mean
    sum (u_i x_i / P_i) / information.
    """
    share = 1 / variance[:, :3].sum(axis=1)
    share /= np.bincount(row, share, count)[row]
    weighted = share[:, None] / variance
    information = _sums(row, weighted, count)
    return _sums(row, weighted * mean, count) / information, information


def _mean_heading(row: Ints, yaw: Array, variance: Array, count: int) -> Array:
    """Return the heading (count,) [rad] of each object: the mean axis of its boxes, facing as most of them do."""
    # The mean of doubled angles is that of axes, which half a turn does not change.
    weight = 1 / variance
    sin, cos = (np.bincount(row, weight * wave(2 * yaw), count) for wave in (np.sin, np.cos))
    axis = np.arctan2(sin, cos) / 2
    ahead = np.bincount(row, weight * np.cos(yaw - axis[row]), count)
    return wrap_angle(np.where(ahead >= 0, axis, axis + np.pi))


def _sums(row: Ints, values: Array, count: int) -> Array:
    """Return the sums (count, 7) of `values` (N, 7) over equal entries of `row`."""
    out = np.zeros((count, values.shape[1]))
    np.add.at(out, row, values)
    return out


def _scores(boxes: Boxes) -> Array:
    return np.ones(len(boxes)) if boxes.score is None else boxes.score


@dataclass(frozen=True)
class Navigation:
    """Standard deviations of a vehicle's pose, as its navigation states them."""

    position_m: float  # along x and along y
    heading_rad: float


@dataclass(frozen=True)
class Sighting:
    """An agent's observation in one spin: its estimated pose, boxes and posts."""

    agent: str
    time_s: float  # by its clock
    world_from_agent: Array  # (4, 4) [m] as its navigation estimates; of a road sensor as surveyed
    boxes: Boxes  # agent's frame, its origin on the ground, with scores and variances
    posts: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (L, 2) feet of posts, agent's frame [m]
    navigation: Navigation | None = None  # None: surveyed, a road sensor


def report_boxes(sighting: Sighting) -> BoxReport:
    """Return an agent's report of a spin: its boxes in the world frame, with its pose's uncertainty in their variances.

    A heading error moves a box at distance r by r times the error, across the line of sight.
    """
    boxes = sighting.boxes.transform(sighting.world_from_agent)
    return BoxReport(sighting.agent, sighting.time_s, add_pose_variance(boxes, sighting))


def add_pose_variance(boxes: Boxes, sighting: Sighting) -> Boxes:
    """Return boxes, world frame, with the variance of an agent's pose added to theirs; unchanged for road sensors."""
    if sighting.navigation is None:
        return boxes
    known = sighting.navigation
    variance = variance_of(boxes)
    lever = boxes.center[:, :2] - sighting.world_from_agent[:2, 3]
    variance[:, :2] += known.position_m**2 + (lever[:, ::-1] * known.heading_rad) ** 2
    variance[:, YAW] += known.heading_rad**2
    return replace(boxes, variance=variance)


class NavigationErrors(Config):
    """Standard deviations of the errors of vehicles' poses, drawn in each frame, and clocks, drawn in each scene."""

    position_m: float = Field(default=0.0, ge=0, le=10)  # of a vehicle's position, along x and along y
    heading_deg: float = Field(default=0.0, ge=0, le=45)  # of its heading
    clock_s: float = Field(default=0.0, ge=0, le=1)  # of its clock's offset, one in each scene

    @property
    def stated(self) -> Navigation:
        """Return the accuracy that a vehicle states."""
        return state_accuracy(self.position_m, float(np.radians(self.heading_deg)))

    def navigate(self, world_from_agent: Array, rng: np.random.Generator) -> Array:
        """Return a vehicle's estimated pose (4, 4) [m]: the true one with errors drawn from `rng`."""
        shift_m = self.position_m * rng.standard_normal(2)
        turned = np.radians(self.heading_deg) * rng.standard_normal()
        known = world_from_agent @ pose(0, 0, 0, float(turned))
        known[:2, 3] = world_from_agent[:2, 3] + shift_m
        return known


ESTIMATED: Literal["estimated"] = "estimated"
PoseSource = NavigationErrors | Literal["estimated"]  # "estimated": see `flcav.fusion.inertial`; clocks are exact


def state_accuracy(position_m: float, heading_rad: float) -> Navigation:
    """Return the standard deviations that a vehicle states: at least 0.01 m and 0.001 rad."""
    return Navigation(max(position_m, 0.01), max(heading_rad, 0.001))
