"""Labels from a vehicle's drive: objects tracked through the sweeps around a frame, each fitted to all its returns.

Stage II is not real time: what a vehicle missed in one sweep it may detect in earlier and later ones (Qi et al.,
"Offboard 3D Object Detection from Point Cloud Sequences", CVPR 2021; Ma et al., "DetZero", ICCV 2023). Detections of
all sweeps are joined to objects of constant velocity; the returns of an object in all of them, aggregated in its frame,
then determine what a network trained in another town estimates poorly: its heading, by the edges of the returns
(Zhang et al., "Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners", IV 2017, algorithm 3: closeness),
and its size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Mask
from flcav.fusion.announced import HEADED_RAD, SURE_M, Announced, is_seen_through, keep_in_ellipse, shift_onto_returns
from flcav.fusion.average import BoxReport, RoadAverage, average_boxes
from flcav.geometry import Boxes, concatenate, heading_vectors, points_in_boxes

LEAST_SCORE = 0.1  # of a track
VEHICLE_M = 2.0  # least length of an object that is fitted: pedestrians and two-wheelers are not rigid
STANDING_MPS = 0.7  # slower objects are stationary
MOVING_S = 0.45  # returns of moving objects are aggregated up to this time before and after
ABOVE_M, BELOW_M = 0.25, 3.6  # heights above an object's underside between which returns belong to it
REACH_M = 5.0  # from an object's centre to its farthest return
MARGIN_M = 0.3  # around a detected box, within which returns belong to the object
LEAST_RETURNS = 8  # of an object that is fitted
LEAST_SEEN = 3  # returns of an announced object in the frame that is labelled
TURN_RAD, TURNS = 0.16, 17  # headings that are tried: greatest deviation from the detected one, and their number
TURNED_RETURNS = 25  # of an object whose heading is fitted
BIN_M, BIN_RETURNS = 0.1, 2  # bins of the histogram along an axis, and least returns in an occupied one
GAP_M = (0.35, 0.25)  # along and across: a longer gap without returns is the end of an object
ROOM_M = (1.6, 0.45)  # along and across: greatest extent of an object beyond the detected box
EDGE_M = 0.08  # least distance from an edge in the closeness: nearer returns count as this far
LONGEST_M = 6.3  # of cars and vans
HIDDEN = 0.9  # the roof was not observed where the highest return is below this share of the detected height
RING_RAD = 0.003  # elevations of returns of one beam differ by less
LENGTH_M = 2.35, 1.4  # length of a vehicle by its height: a hatchback of 1.46 m has 4.4 m, a van of 1.95 m 5.1 m


@dataclass(frozen=True)
class VehicleSweep:
    """One LiDAR spin of a vehicle, world frame by the pose of its navigation."""

    time_s: float
    boxes: Boxes  # detections, with scores
    points: Array  # (N, 3) returns [m]
    origin: Array  # (3,) of the LiDAR [m]


def track_objects(
    sweeps: Sequence[VehicleSweep],
    at_s: float,
    others: Sequence[BoxReport] = (),
    least: float = 0.0,
    announced: Announced | None = None,
) -> Boxes:
    """Return the objects at `at_s` [s] that a vehicle detects in the sweeps around it, world frame.

    An object's score is its mean over the sweeps, zero in those without a detection of it; with boxes of `others`, such
    as road sensors, the probability that at least one is right, see `average_boxes`. The height of the underside is by
    the vehicle's detections where there are any, since road sensors measure it less well from above. Objects that score
    less than `least` are left out. Vehicles are fitted to their returns, see `fit_vehicle`; trucks and buses then have
    the score 0.

    Boxes of `announced` vehicles join the others, and so do those that these perceive; length and width of the former
    are known. One that neither this vehicle nor `others` report is moved onto the returns near it; it has the score 0
    where there are too few of them to place it, and so has any announced one that is hidden at `at_s`. It is left out
    where the sweeps see through it, or where it comes to lie on another object.
    """
    seen_by = [*(BoxReport("vehicle", sweep.time_s, sweep.boxes) for sweep in sweeps), *others]
    average = average_boxes([*seen_by, *((announced.report, *announced.perceived) if announced else ())], at_s)
    assert average.boxes.score is not None
    kept = np.flatnonzero(average.boxes.score >= least)
    boxes = average.boxes[kept]
    velocity = average.velocity[kept]
    rows = boxes.array()
    score = average.boxes.score[kept]
    feet = _average_feet(sweeps, average)[kept]
    seen = np.isfinite(feet)
    rows[seen, 2] = feet[seen] + rows[seen, 5] / 2
    alone = ~np.isin(kept, np.concatenate([np.zeros(0, np.int64), *average.member[: len(seen_by)]]))
    told = np.full(len(average.boxes), -1)  # row of the announced vehicle
    if announced:
        told[average.member[len(seen_by)]] = np.arange(len(announced.report.boxes))
    told = told[kept]
    if announced:
        velocity[alone & (told >= 0)] = announced.velocity[told[alone & (told >= 0)]]
    lost = np.zeros(len(rows), np.bool_)
    assert boxes.variance is not None
    deviation_m = np.sqrt(boxes.variance[:, 0])
    current = [min(sweeps, key=lambda sweep: abs(sweep.time_s - at_s))]
    rigid = boxes.size[:, 0] >= VEHICLE_M
    for number in np.flatnonzero(rigid | (told >= 0)):
        if alone[number]:
            near, _ = gather_returns(rows[number], velocity[number], sweeps, at_s)
            rows[number, :2] += shift_onto_returns(rows[number], near, deviation_m[number])
            around = _move_along(velocity[number], sweeps, at_s)
            lost[number] |= is_seen_through(rows[number], deviation_m[number], *around)
            lost[number] |= _overlaps(rows[number], rows[~alone])
        returns, origin = gather_returns(rows[number], velocity[number], sweeps, at_s)
        if alone[number] and deviation_m[number] > SURE_M and count_core(rows[number], returns) < LEAST_RETURNS:
            score[number] = 0.0
            rows[number, 3:5] += 2 * deviation_m[number]
            continue
        own = announced.report.boxes[told[[number]]] if announced and told[number] >= 0 else None
        if rigid[number]:
            rows[number] = fit_vehicle(rows[number], returns, origin, own)
        if own is not None:
            rows[number, :2] = keep_in_ellipse(rows[number, :2], own)
        if own is not None or alone[number]:
            returns, _ = gather_returns(rows[number], velocity[number], current, at_s)
            score[number] *= count_core(rows[number], returns) >= LEAST_SEEN
        if rows[number, 3] > LONGEST_M:
            score[number] = 0.0
    return Boxes.from_array(rows, boxes.label, score)[~lost]


def _overlaps(box: Array, others: Array) -> bool:
    """Return whether the centre of a box (7,) lies within one of the others (N, 7), in bird's-eye view."""
    place = np.append(box[:2], 0)[None]
    return bool(points_in_boxes(place, Boxes.from_array(others * (1, 1, 0, 1, 1, 1, 1), "")).any())


def _move_along(velocity: Array, sweeps: Sequence[VehicleSweep], at_s: float) -> tuple[list[Array], list[Array]]:
    """Return returns (N, 3) and origin (3,) of each sweep, moved with an object to where it is at `at_s`."""
    moves = bool(np.hypot(*velocity) >= STANDING_MPS)
    near = [sweep for sweep in sweeps if not moves or abs(sweep.time_s - at_s) <= MOVING_S]
    steps = [np.append(velocity * (sweep.time_s - at_s) * moves, 0) for sweep in near]
    return [each.points - step for each, step in zip(near, steps)], [e.origin - s for e, s in zip(near, steps)]


def _average_feet(sweeps: Sequence[VehicleSweep], average: RoadAverage) -> Array:
    """Return the mean height (K,) [m] of each object's underside in the vehicle's detections; NaN without any."""
    of = np.concatenate([np.zeros(0, np.int64), *average.member[: len(sweeps)]])
    boxes = concatenate([sweep.boxes for sweep in sweeps])
    counts = np.bincount(of, minlength=len(average.agents))
    sums = np.bincount(of, boxes.center[:, 2] - boxes.size[:, 2] / 2, len(counts))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def gather_returns(box: Array, velocity: Array, sweeps: Sequence[VehicleSweep], at_s: float) -> tuple[Array, Array]:
    """Return the returns (N, 3) around an object in all sweeps, and the nearest place (3,) of the LiDAR.

    Both are x, y from the object's centre and height above its underside [m], world axes. box: (7,) at `at_s`, world
    frame; velocity: (2,) [m/s], world axes.
    """
    moves = bool(np.hypot(*velocity) >= STANDING_MPS)
    foot = box[:3] - (0, 0, box[5] / 2)
    returns = [np.zeros((0, 3))]
    origins = [np.full(3, np.inf)]
    for sweep in sweeps:
        after_s = sweep.time_s - at_s
        if moves and abs(after_s) > MOVING_S:
            continue
        place = foot + np.append(velocity * after_s * moves, 0)
        near = sweep.points[((sweep.points[:, :2] - place[:2]) ** 2).sum(1) < REACH_M**2] - place
        returns.append(near[(near[:, 2] > ABOVE_M) & (near[:, 2] < BELOW_M)])
        origins.append(sweep.origin - place)
    return np.concatenate(returns), min(origins, key=lambda origin: float(np.hypot(*origin[:2])))


def fit_vehicle(box: Array, returns: Array, origin: Array, known: Boxes | None = None) -> Array:
    """Return the box (7,) of a vehicle fitted to its returns (N, 3), see `gather_returns`; unchanged with too few.

    The height of the underside is kept. The heading is aligned with the edges of the returns. Length and width extend
    as far as there are returns without a gap. On the sides that face away from the `origin` (3,), where the LiDAR
    observes none, they are at least as detected, or as usual for the vehicle's height. The top is above the highest
    return by half the spacing of the beams. `known`: one announced box, whose length and width are kept,
    and whose heading where it is stated to be accurate.
    """
    x, y, _, length, width, height, yaw = box
    along = heading_vectors(yaw)
    axes = np.array([along, (-along[1], along[0])])
    plane = returns[:, :2] @ axes.T
    core = _in_core(plane, box)
    if core.sum() < LEAST_RETURNS:
        return box
    headed = known is not None and known.variance is not None and known.variance[0, 6] <= HEADED_RAD**2
    if core.sum() >= TURNED_RETURNS and not headed:
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
        # The top lies between the highest return and the next beam above, on average in the middle.
        height = top + _beam_height(returns[inside], origin) / 2
    middle = (low + high) / 2
    seen_from = axes @ origin[:2]
    if high[0] - low[0] < length or abs(seen_from[1]) < abs(seen_from[0]):  # unless the whole flank is observed
        length = max(length, LENGTH_M[0] + LENGTH_M[1] * height)
    size = np.maximum((length, width), high - low) if known is None else known.size[0, :2]
    outside = np.abs(seen_from) > np.array((length, width)) / 2
    # The observed edge stays: the box grows away from a LiDAR outside of it, else towards the detected centre.
    middle -= np.sign(np.where(outside, seen_from, middle)) * (size - (high - low)) / 2
    x, y = (x, y) + middle @ axes
    return np.array((x, y, box[2] - box[5] / 2 + height / 2, *size, height, np.arctan2(axes[0, 1], axes[0, 0])))


def count_core(box: Array, returns: Array) -> int:
    """Return the number of returns (N, 3), see `gather_returns`, in a box (7,) or within `MARGIN_M` of it."""
    along = heading_vectors(box[6])
    return int(_in_core(returns[:, :2] @ np.array([along, (-along[1], along[0])]).T, box).sum())


def _in_core(plane: Array, box: Array) -> Mask:
    return np.asarray((np.abs(plane) < box[3:5] / 2 + MARGIN_M).all(1))


def _fit_turn(plane: Array) -> float:
    """Return the turn [rad] of the axes by which most returns (N, 2) [m] lie near two edges."""
    turns = np.linspace(-TURN_RAD, TURN_RAD, TURNS)
    cos = np.cos(turns)
    sin = np.sin(turns)
    turned = np.einsum("nk,tkj->tnj", plane, np.stack((np.stack((cos, -sin), 1), np.stack((sin, cos), 1)), 1))
    low, high = np.percentile(turned, (1, 99), axis=1, keepdims=True)
    away = np.minimum(turned - low, high - turned).clip(0).min(2)  # (turns, N) from the nearest edge
    return float(turns[(1 / np.maximum(away, EDGE_M)).sum(1).argmax()])


def _find_extent(values: Array, half_m: float, gap_m: float) -> tuple[float, float]:
    """Return the ends [m] of the `values` (N,) [m] that are connected, without a gap, to those within `half_m` of 0."""
    first = np.floor(values.min(initial=0) / BIN_M)
    held = np.flatnonzero(np.bincount((np.floor(values / BIN_M) - first).astype(int)) >= BIN_RETURNS)
    core = np.abs((held + first + 0.5) * BIN_M) <= half_m
    if not core.any():
        return -half_m, half_m
    part = np.cumsum(np.diff(held, prepend=held[0]) > round(gap_m / BIN_M))  # number of each connected group of bins
    connected = held[(part >= part[core].min()) & (part <= part[core].max())]
    low = (connected[0] + first) * BIN_M
    high = (connected[-1] + 1 + first) * BIN_M
    lowest, highest = np.percentile(values[(values >= low) & (values <= high)], (1, 99))
    return float(lowest), float(highest)


def _beam_height(returns: Array, origin: Array) -> float:
    """Return the spacing [m] of the LiDAR's beams on an object, by the elevations of its returns (N, 3) [m]."""
    distance = np.linalg.norm(returns[:, :2] - origin[:2], axis=1)
    elevation = np.sort(np.arctan2(returns[:, 2] - origin[2], distance))
    steps = np.diff(elevation)
    steps = steps[steps > RING_RAD]
    return float(np.median(steps) * distance.min()) if len(steps) else 0.0
