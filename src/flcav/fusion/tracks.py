"""Labels from a vehicle's own drive: objects tracked through the sweeps around a frame, each fitted to all its returns.

Stage II is not real time: what a vehicle missed in one sweep it drove past in others, before and after (Qi et al.,
"Offboard 3D Object Detection from Point Cloud Sequences", CVPR 2021; Ma et al., "DetZero", ICCV 2023). Detections of
all sweeps are joined to objects of constant velocity; the returns of an object in all of them, laid over one another in
its own frame, then say what a network of another town does not know: its heading, by the edges of the returns (Zhang et
al., "Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners", IV 2017, algorithm 3: closeness), and its
size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array
from flcav.fusion.average import BoxReport, RoadAverage, average_boxes
from flcav.geometry import Boxes, concatenate, heading_vectors

LEAST_SCORE = 0.1  # of a track
VEHICLE_M = 2.0  # length from which an object is fitted: those on foot and on two wheels bend
STANDING_MPS = 0.7  # slower objects stand
MOVING_S = 0.45  # returns of moving objects are laid over one another up to so long before and after
ABOVE_M, BELOW_M = 0.25, 3.6  # heights above an object's underside between which returns are its own
REACH_M = 5.0  # from an object's centre to its farthest return
MARGIN_M = 0.3  # of a detected box, in which returns are the object's own
LEAST_RETURNS = 8  # of an object that is fitted
TURN_RAD, TURNS = 0.16, 17  # headings that are tried: up to so far to either side of the detected one
TURNED_RETURNS = 25  # of an object whose heading is fitted
BIN_M, BIN_RETURNS = 0.1, 2  # of the histogram along an axis by which an object ends
GAP_M = (0.35, 0.25)  # along and across: a longer gap without returns ends an object
ROOM_M = (1.6, 0.45)  # along and across: how far an object may go on beyond the detected box
EDGE_M = 0.08  # closeness of returns nearer to an edge than this is that of this
LONGEST_M = 6.3  # of cars and vans
HIDDEN = 0.9  # where the highest return is below this share of the detected height, the roof was not seen
RING_RAD = 0.003  # elevations of returns of one beam differ by less
LENGTH_M = 2.35, 1.4  # length of a vehicle by its height: a hatchback of 1.46 m has 4.4 m, a van of 1.95 m 5.1 m


@dataclass(frozen=True)
class VehicleSweep:
    """One LiDAR spin of a vehicle, by the pose that its navigation gives; world frame."""

    time_s: float
    boxes: Boxes  # detections, with scores
    points: Array  # (N, 3) returns [m]
    origin: Array  # (3,) of the LiDAR [m]


def track_objects(
    sweeps: Sequence[VehicleSweep], at_s: float, others: Sequence[BoxReport] = (), least: float = 0.0
) -> Boxes:
    """Return the objects at `at_s` [s] of a vehicle's sweeps around it, world frame.

    An object's score is its mean over the sweeps, zero in those without a detection of it; with boxes of `others`, such
    as road sensors, the probability that not all err, see `average_boxes`. The underside of what the vehicle saw itself
    is where it saw it: from above, road sensors know it less well. Objects that score less than `least` are left out.
    Vehicles are fitted to their returns, see `fit_vehicle`; trucks and buses then score 0.
    """
    average = average_boxes([*(BoxReport("vehicle", each.time_s, each.boxes) for each in sweeps), *others], at_s)
    assert average.boxes.score is not None
    kept = np.flatnonzero(average.boxes.score >= least)
    boxes, velocity = average.boxes[kept], average.velocity[kept]
    rows, score = boxes.array(), average.boxes.score[kept]
    feet = _average_feet(sweeps, average)[kept]
    seen = np.isfinite(feet)
    rows[seen, 2] = feet[seen] + rows[seen, 5] / 2
    for number in np.flatnonzero(boxes.size[:, 0] >= VEHICLE_M):
        returns, origin = gather_returns(rows[number], velocity[number], sweeps, at_s)
        rows[number] = fit_vehicle(rows[number], returns, origin)
        if rows[number, 3] > LONGEST_M:
            score[number] = 0.0
    return Boxes.from_array(rows, boxes.label, score)


def _average_feet(sweeps: Sequence[VehicleSweep], average: RoadAverage) -> Array:
    """Return the mean height (K,) of the undersides that the vehicle itself saw of each object [m]; NaN where none."""
    of = np.concatenate([np.zeros(0, np.int64), *average.member[: len(sweeps)]])
    boxes = concatenate([each.boxes for each in sweeps])
    counts = np.bincount(of, minlength=len(average.agents))
    sums = np.bincount(of, boxes.center[:, 2] - boxes.size[:, 2] / 2, len(counts))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def gather_returns(box: Array, velocity: Array, sweeps: Sequence[VehicleSweep], at_s: float) -> tuple[Array, Array]:
    """Return the returns (N, 3) around an object in all sweeps, and the nearest place (3,) that it was seen from.

    Both are x, y from the object's centre and height above its underside [m], along the axes of the world. box: (7,) at
    `at_s`, world frame; velocity: (2,) [m/s].
    """
    moves = bool(np.hypot(*velocity) >= STANDING_MPS)
    foot = box[:3] - (0, 0, box[5] / 2)
    returns, origins = [np.zeros((0, 3))], [np.full(3, np.inf)]
    for sweep in sweeps:
        after_s = sweep.time_s - at_s
        if moves and abs(after_s) > MOVING_S:
            continue
        place = foot + np.append(velocity * after_s * moves, 0)
        near = sweep.points[((sweep.points[:, :2] - place[:2]) ** 2).sum(1) < REACH_M**2] - place
        returns.append(near[(near[:, 2] > ABOVE_M) & (near[:, 2] < BELOW_M)])
        origins.append(sweep.origin - place)
    return np.concatenate(returns), min(origins, key=lambda each: float(np.hypot(*each[:2])))


def fit_vehicle(box: Array, returns: Array, origin: Array) -> Array:
    """Return the box (7,) of a vehicle fitted to its returns (N, 3), see `gather_returns`; as it is with too few.

    Its underside stays. The heading is turned to the edges of the returns. Along and across it goes as far as there are
    returns without a gap, and away from the `origin` (3,), which sees the near side, at least as far as detected, or
    as vehicles of its height do. It is higher than the highest return by half of what lies between two beams.
    """
    x, y, _, length, width, height, yaw = box
    along = heading_vectors(yaw)
    axes = np.array([along, (-along[1], along[0])])
    plane = returns[:, :2] @ axes.T
    core = (np.abs(plane) < np.array((length, width)) / 2 + MARGIN_M).all(1)
    if core.sum() < LEAST_RETURNS:
        return box
    if core.sum() >= TURNED_RETURNS:
        turned = heading_vectors(_fit_turn(plane[core]))
        axes = np.array([turned, (-turned[1], turned[0])]) @ axes
        plane = returns[:, :2] @ axes.T
    u, v = plane.T
    near = (np.abs(u) < length / 2 + MARGIN_M) & (np.abs(v) < width / 2 + ROOM_M[1])
    sides = _find_extent(v[near], (width + MARGIN_M) / 2, GAP_M[1])
    near = (v > sides[0] - BIN_M) & (v < sides[1] + BIN_M) & (np.abs(u) < length / 2 + ROOM_M[0])
    ends = _find_extent(u[near], length / 2, GAP_M[0])
    low, high = np.transpose((ends, sides))
    inside = ((plane > low - BIN_M) & (plane < high + BIN_M)).all(1)
    if inside.sum() < LEAST_RETURNS:
        return box
    top = float(np.percentile(returns[inside, 2], 99))
    if top >= HIDDEN * height:
        height = top + _beam_height(returns[inside], origin) / 2
    middle, seen_from = (low + high) / 2, axes @ origin[:2]
    if high[0] - low[0] < length or abs(seen_from[1]) < abs(seen_from[0]):  # else its flank is seen to the end
        length = max(length, LENGTH_M[0] + LENGTH_M[1] * height)
    size = np.maximum((length, width), high - low)
    beside = np.abs(seen_from) > np.array((length, width)) / 2
    middle -= np.sign(np.where(beside, seen_from, middle)) * (size - (high - low)) / 2  # half of what is hidden
    x, y = (x, y) + middle @ axes
    return np.array((x, y, box[2] - box[5] / 2 + height / 2, *size, height, np.arctan2(axes[0, 1], axes[0, 0])))


def _fit_turn(plane: Array) -> float:
    """Return by how much [rad] the axes of returns (N, 2) are to be turned for most of them to lie near two edges."""
    turns = np.linspace(-TURN_RAD, TURN_RAD, TURNS)
    cos, sin = np.cos(turns), np.sin(turns)
    turned = np.einsum("nk,tkj->tnj", plane, np.stack((np.stack((cos, -sin), 1), np.stack((sin, cos), 1)), 1))
    low, high = np.percentile(turned, (1, 99), axis=1, keepdims=True)
    away = np.minimum(turned - low, high - turned).clip(0).min(2)  # (turns, N) from the nearest edge
    return float(turns[(1 / np.maximum(away, EDGE_M)).sum(1).argmax()])


def _find_extent(values: Array, half_m: float, gap_m: float) -> tuple[float, float]:
    """Return the ends of the `values` (N,) [m] that go on, without a gap, from those within `half_m` of 0."""
    first = np.floor(values.min(initial=0) / BIN_M)
    held = np.flatnonzero(np.bincount((np.floor(values / BIN_M) - first).astype(int)) >= BIN_RETURNS)
    core = np.abs((held + first + 0.5) * BIN_M) <= half_m
    if not core.any():
        return -half_m, half_m
    part = np.cumsum(np.diff(held, prepend=held[0]) > round(gap_m / BIN_M))  # of bins between which is no gap
    own = held[(part >= part[core].min()) & (part <= part[core].max())]
    low, high = (own[0] + first) * BIN_M, (own[-1] + 1 + first) * BIN_M
    lowest, highest = np.percentile(values[(values >= low) & (values <= high)], (1, 99))
    return float(lowest), float(highest)


def _beam_height(returns: Array, origin: Array) -> float:
    """Return how far apart [m] the LiDAR's beams are on an object, by the elevations of its returns (N, 3)."""
    away = np.linalg.norm(returns[:, :2] - origin[:2], axis=1)
    elevation = np.sort(np.arctan2(returns[:, 2] - origin[2], away))
    steps = np.diff(elevation)
    steps = steps[steps > RING_RAD]
    return float(np.median(steps) * away.min()) if len(steps) else 0.0
