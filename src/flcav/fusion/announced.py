"""Vehicles that announce themselves by radio, in the sweeps of a vehicle that hears them.

An announced position is off by up to metres, mostly by the same amount through a drive. Where the vehicle has no
detection of the sender, the announced box is moved onto the returns near it. A sender whose box the sweeps see through
is refused: nothing is there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Ints, Words
from flcav.fusion.average import BoxReport
from flcav.geometry import Boxes, heading_vectors, points_in_boxes, segments_meet_boxes
from flcav.network.awareness import ELLIPSE, AwarenessMessages

AGENT = "messages"  # name of the report of announced vehicles
HEARD_S = 1.0  # time before and after a frame within which messages count
HEIGHT_M, PERSON_M = 1.55, 1.73  # of an announced vehicle and person, until returns tell: a message has none
DEVIATION = np.array((0.0, 0.0, 0.2, 0.1, 0.1, 0.2, 0.0))  # of an announced box, beside what is stated
PERSON_DEVIATION_M = 0.3  # of length and width, which a person's message does not state
HEADED_RAD = 0.03  # standard deviation of a heading up to which it is kept
MOTION_M = 0.1  # error of a position that is continued between messages
SHIFT_M = 0.15  # step of the shifts that are tried
SHELL_M, BESIDE_M = 0.25, 0.6  # depth of the flanks that returns lie on; reach beside the box where none should be
DATA = 20.0  # weight of the share of returns that a shift explains against its squared deviation
MOST_RETURNS = 300  # of an announced vehicle that shifts are tried on
CORE_M = 0.4  # a ray that comes within this of a box's flanks does not pass through it
LOW_M = 0.5  # as much of a box's height is left out, half of it at the ground
THROUGH, HELD = 5, 0.1  # least rays through a box that is refused, and fewer returns near it than this share of them
SURE_M = 0.25  # standard deviation of a position up to which a vehicle with a return has a label without more of them


@dataclass(frozen=True)
class Announced:
    """Announced vehicles at the time that labels are for, and what others detect then, world frame."""

    report: BoxReport  # of N vehicles
    velocity: Array  # (N, 2) [m/s]
    senders: Ints  # (N,)
    perceived: tuple[BoxReport, ...] = ()


def place_senders(
    messages: AwarenessMessages, at_s: float, ground: Callable[[Array], Array], label: Callable[[Ints], Words]
) -> Announced:
    """Return where the senders of messages are at `at_s` [s].

    A position is that of the two messages nearest in time, each continued at its velocity and weighted by nearness.
    ground: heights (N,) [m] at places (N, 2) of the world. label: (N,) classes of senders (N,): cars, or persons.
    """
    senders = np.unique(messages.sender)
    classes = label(senders)
    person = classes != "Car"
    rows, variance = np.zeros((len(senders), 7)), np.tile(DEVIATION**2, (len(senders), 1))
    velocity = np.zeros((len(senders), 2))
    for number, sender in enumerate(senders):
        own = messages[messages.sender == sender]
        since = at_s - own.time_s
        near = np.argsort(np.abs(since), kind="stable")[:2]
        weight = 1 / (np.abs(since[near]) + 0.05)
        along = heading_vectors(own.heading[near])
        size = own.size[near[0]] - (0.0 if person[number] else 0.05)  # the middle of what an announced tenth stands for
        center = own.front[near] + along * (own.speed[near] * since[near] - size[0] / 2)[:, None]
        rows[number, :2] = weight @ center / weight.sum()
        rows[number, 3:] = (*size, PERSON_M if person[number] else HEIGHT_M, own.heading[near[0]])
        variance[number, :2] = own.deviation_m[near[0]] ** 2
        variance[number, 6] = own.turn_rad[near[0]] ** 2
        velocity[number] = along[0] * own.speed[near[0]]
    rows[:, 2] = ground(rows[:, :2]) + rows[:, 5] / 2
    variance[person, 3:5] = PERSON_DEVIATION_M**2
    boxes = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], classes, np.ones(len(senders)), variance)
    return Announced(BoxReport(AGENT, at_s, boxes), velocity, senders)


def shift_onto_returns(box: Array, returns: Array, deviation_m: float) -> Array:
    """Return the shift (2,) [m, world axes] of an announced box by which it fits the returns (N, 3) around it best.

    box: (7,); returns: as of `gather_returns`. The score of a shift is the share of returns within `SHELL_M` of a
    flank inside, less that of returns beside the box, against the shift's likelihood by the standard deviation.
    """
    plane = returns[:: max(1, len(returns) // MOST_RETURNS), :2]
    reach = np.arange(-ELLIPSE * deviation_m, ELLIPSE * deviation_m + SHIFT_M, SHIFT_M)
    shifts = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    shifts = np.concatenate((np.zeros((1, 2)), shifts[np.hypot(*shifts.T) <= ELLIPSE * deviation_m]))
    along = heading_vectors(box[6])
    axes = np.array((along, (-along[1], along[0])))
    inside = (box[3:5] / 2 - np.abs((plane - shifts[:, None]) @ axes.T)).min(axis=2)  # (K, N) depth below the flanks
    score = ((inside >= 0) & (inside <= SHELL_M)).sum(axis=1) + 0.3 * (inside > SHELL_M).sum(axis=1)
    score = score - ((inside < 0) & (inside >= -BESIDE_M)).sum(axis=1)
    prior = (shifts**2).sum(axis=1) / (2 * deviation_m**2)
    return shifts[(DATA * score / max(len(plane), 1) - prior).argmax()]


def keep_in_ellipse(place: Array, told: Boxes) -> Array:
    """Return the place (2,) [m], or where it is outside the stated ellipse of one announced box, the nearest inside."""
    assert told.variance is not None
    off = place - told.center[0, :2]
    reach_m = ELLIPSE * float(np.sqrt(told.variance[0, 0])) + MOTION_M
    return told.center[0, :2] + off * min(1.0, reach_m / max(float(np.hypot(*off)), 1e-9))


def is_seen_through(box: Array, deviation_m: float, points: Sequence[Array], origins: Sequence[Array]) -> bool:
    """Return whether rays pass through a box (7,) with next to no returns where it may be.

    points: of each sweep (N, 3) [m], and origins (3,) its LiDAR, in the frame of the box at the sweep's time.
    """
    slack_m = 2 * ELLIPSE * deviation_m + CORE_M
    core, near = (
        Boxes.from_array(np.concatenate((box[:3], np.maximum(box[3:6] + grown, 0.1), box[6:])), "")
        for grown in ((-2 * CORE_M, -2 * CORE_M, -LOW_M), (slack_m, slack_m, -LOW_M))
    )
    toward, through, held = [box[:2] - origin[:2] for origin in origins], 0, 0
    for cloud, origin, way in zip(points, origins, toward, strict=True):
        away = cloud[:, :2] - origin[:2]
        aside_m = np.abs(away @ np.array((-way[1], way[0])))  # times the box's distance, as is the other side
        ahead = cloud[(aside_m <= np.hypot(*near.size[0, :2]) / 2 * np.hypot(*away.T)) & (away @ way > 0)]
        there = points_in_boxes(ahead, near)[0]
        beyond = ahead[~there]
        through += int(segments_meet_boxes(np.tile(origin, (len(beyond), 1)), beyond, core).sum())
        held += int(there.sum())
    return through >= THROUGH and held < HELD * through
