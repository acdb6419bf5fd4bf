"""Contacts of upright boxes, as rigid bodies in plan: separating axis test, position correction and impulses.

Overlapping boxes are moved apart along the axis of least overlap, and those that approach exchange a frictionless
impulse at the contact (Baraff, An Introduction to Physically Based Modeling, 1997, part II, section 8).
"""

from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Ints
from flcav.machine.compiled import compiled

RESTITUTION = 0.1  # coefficient of restitution: separation over approach speed, along the normal
PASSES = 12  # of position correction over all pairs of neighbours
SLOP_M = 1e-6  # gap between two boxes after they are moved apart
HEAVY = 5.0  # mass ratio above which only the lighter box is moved aside
UNDO_PASSES = 1000  # of putting overlapping boxes back


class Footprints(NamedTuple):
    """Footprints and vertical extents of N upright boxes, world frame."""

    place: Array  # (N, 3) x, y [m] of the centre, and yaw [rad]
    half: Array  # (N, 2) half length and half width [m]
    level: Array  # (N, 2) lowest and highest z [m]


class Contacts(NamedTuple):
    """C contacts between pairs of boxes, world frame."""

    first: Ints  # (C,) row of a box
    second: Ints  # (C,) row of the other box, greater than `first`
    normal: Array  # (C, 2) unit vector from the second towards the first box
    point: Array  # (C, 2) contact point x, y [m]
    impulse: Array  # (C,) impulse on the first box, along the normal [N s]


def resolve_contacts(
    boxes: Footprints, before: Array, velocity: Array, yaw_rate: Array, mass: Array, inertia: Array
) -> tuple[Array, Array, Array, Contacts]:
    """Return places (N, 3) [m, rad], velocities (N, 2) [m/s], yaw rates (N,) [rad/s] after contacts, and the contacts.

    `mass` (N,) [kg] and `inertia` (N,) [kg m^2] are infinite for immovable boxes. `before` (N, 3) are the places before
    the last motion: a box that still overlaps after `PASSES` returns there and stops. Boxes that did not overlap before
    the motion therefore do not overlap after it, unless something immovable was moved into them.
    """
    place, velocity, yaw_rate = boxes.place.copy(), velocity.copy(), yaw_rate.copy()
    pairs = _find_neighbours(place, before, boxes.half, boxes.level, 1 / mass)
    normal, point, impulse = np.zeros((len(pairs), 2)), np.zeros((len(pairs), 2)), np.zeros(len(pairs))
    touched = np.zeros(len(pairs), np.bool_)
    _resolve(
        pairs, place, before, boxes.half, velocity, yaw_rate, 1 / mass, 1 / inertia, normal, point, impulse, touched
    )
    first, second = pairs[touched].T
    return place, velocity, yaw_rate, Contacts(first, second, normal[touched], point[touched], impulse[touched])


def find_overlaps(boxes: Footprints, others: Footprints) -> Ints:
    """Return the overlapping pairs (K, 2): rows of `boxes` and of `others`."""
    both = Footprints(*(np.concatenate(pair) for pair in zip(boxes, others)))
    inverse = np.repeat((1.0, 0.0), (len(boxes.place), len(others.place)))
    pairs = _find_neighbours(both.place, both.place, both.half, both.level, inverse)
    pairs = pairs[(pairs[:, 0] < len(boxes.place)) & (pairs[:, 1] >= len(boxes.place))]
    met = np.array([_overlap(both.place, both.half, i, j)[0] > 0 for i, j in pairs], np.bool_)
    return pairs[met] - (0, len(boxes.place)) if len(pairs) else pairs


@compiled
def _find_neighbours(place, before, half, level, inverse_mass):
    """Return the pairs (P, 2) of boxes that may touch, at least one of which can move (broad phase)."""
    count = len(place)
    reach = np.empty(count)
    for i in range(count):
        reach[i] = np.hypot(half[i, 0], half[i, 1])
    moved = np.empty(count)
    for i in range(count):
        moved[i] = np.hypot(place[i, 0] - before[i, 0], place[i, 1] - before[i, 1]) + 1.0
    pairs = []
    for i in range(count):
        for j in range(i + 1, count):
            if inverse_mass[i] == 0 and inverse_mass[j] == 0:
                continue
            near = reach[i] + reach[j] + moved[i] + moved[j]
            if abs(place[i, 0] - place[j, 0]) > near or abs(place[i, 1] - place[j, 1]) > near:
                continue
            if level[i, 0] < level[j, 1] and level[j, 0] < level[i, 1]:
                pairs.append((i, j))
    out = np.empty((len(pairs), 2), np.int64)
    for row, (i, j) in enumerate(pairs):
        out[row, 0], out[row, 1] = i, j
    return out


@compiled
def _overlap(place, half, i, j):
    """Return the penetration depth [m] of two boxes, not positive if they are apart, and its unit axis towards i."""
    dx, dy = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1]
    least, least_x, least_y = np.inf, 0.0, 0.0
    if np.hypot(dx, dy) > np.hypot(half[i, 0], half[i, 1]) + np.hypot(half[j, 0], half[j, 1]):
        return -1.0, 0.0, 0.0
    turn = place[i, 2] - place[j, 2]
    cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
    for side in range(4):
        box, other = (i, j) if side < 2 else (j, i)
        along = side % 2
        angle = place[box, 2] + along * np.pi / 2
        x, y = np.cos(angle), np.sin(angle)
        offset = dx * x + dy * y
        across = half[other, 0] * (sin if along else cos) + half[other, 1] * (cos if along else sin)
        depth = half[box, along] + across - abs(offset)
        if depth < least:
            least = depth
            least_x, least_y = (x, y) if offset >= 0 else (-x, -y)
            if depth <= 0:
                break
    return least, least_x, least_y


@compiled
def _meet(place, before, half, i, j):
    """Return depth and axis as `_overlap` does, but for the axis on which two moving boxes came into contact last.

    Fast boxes overlap deeply after a step, and the axis of least overlap may then be sideways; it is used only if the
    boxes overlapped before, too (separating axis test of moving boxes: Ericson, Real-Time Collision Detection, 2005,
    section 5.5.8).
    """
    least, least_x, least_y = _overlap(place, half, i, j)
    if least <= 0:
        return least, least_x, least_y
    dx, dy = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1]
    was_x, was_y = before[i, 0] - before[j, 0], before[i, 1] - before[j, 1]
    turn = place[i, 2] - place[j, 2]
    cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
    latest = 0.0
    for side in range(4):
        box, other = (i, j) if side < 2 else (j, i)
        along = side % 2
        angle = place[box, 2] + along * np.pi / 2
        x, y = np.cos(angle), np.sin(angle)
        if was_x * x + was_y * y < 0:
            x, y = -x, -y
        across = half[other, 0] * (sin if along else cos) + half[other, 1] * (cos if along else sin)
        gap = was_x * x + was_y * y - half[box, along] - across
        depth = half[box, along] + across - (dx * x + dy * y)
        if gap > 0 and gap / (gap + depth) > latest:
            latest, least, least_x, least_y = gap / (gap + depth), depth, x, y
    return least, least_x, least_y


@compiled
def _find_point(place, half, i, j):
    """Return the contact point [m]: the mean of the corners inside the other box, or else of the two centres."""
    sum_x, sum_y, corners = 0.0, 0.0, 0
    for box, other in ((i, j), (j, i)):
        cos, sin = np.cos(place[box, 2]), np.sin(place[box, 2])
        cos_other, sin_other = np.cos(place[other, 2]), np.sin(place[other, 2])
        for corner in range(4):
            along = half[box, 0] * (1 if corner % 2 else -1)
            aside = half[box, 1] * (1 if corner // 2 else -1)
            x = place[box, 0] + along * cos - aside * sin
            y = place[box, 1] + along * sin + aside * cos
            dx, dy = x - place[other, 0], y - place[other, 1]
            inside = abs(dx * cos_other + dy * sin_other) <= half[other, 0]
            if inside and abs(dy * cos_other - dx * sin_other) <= half[other, 1]:
                sum_x, sum_y, corners = sum_x + x, sum_y + y, corners + 1
    if not corners:
        return (place[i, 0] + place[j, 0]) / 2, (place[i, 1] + place[j, 1]) / 2
    return sum_x / corners, sum_y / corners


@compiled
def _resolve(
    pairs, place, before, half, velocity, yaw_rate, inverse_mass, inverse_inertia, normal, point, impulse, touched
):
    """Move boxes apart and exchange impulses, in place, and record the contacts of the pairs."""
    for _ in range(PASSES):
        apart = True
        for row in range(len(pairs)):
            i, j = pairs[row, 0], pairs[row, 1]
            depth, x, y = _meet(place, before, half, i, j)
            if depth <= 0:
                continue
            apart = False
            if not touched[row]:
                touched[row] = True
                normal[row, 0], normal[row, 1] = x, y  # numbers: whole rows take seconds to compile
                point[row, 0], point[row, 1] = _find_point(place, half, i, j)
            impulse[row] += _strike(row, i, j, place, velocity, yaw_rate, inverse_mass, inverse_inertia, normal, point)
            a, b = inverse_mass[i], inverse_mass[j]
            # The correction is shared by inverse mass, except that a much heavier box does not give way at all.
            a, b = (0.0 if a * HEAVY < b else a), (0.0 if b * HEAVY < a else b)
            move = (depth + SLOP_M) / (a + b)
            place[i, 0] += a * move * x
            place[i, 1] += a * move * y
            place[j, 0] -= b * move * x
            place[j, 1] -= b * move * y
        if apart:
            return
    # Putting a box back may let it overlap another that has moved: repeat until nothing overlaps or everything is back.
    for _ in range(UNDO_PASSES):
        apart = True
        for row in range(len(pairs)):
            i, j = pairs[row, 0], pairs[row, 1]
            if _overlap(place, half, i, j)[0] <= 0:
                continue
            for body in (i, j):
                away = (
                    place[body, 0] != before[body, 0]
                    or place[body, 1] != before[body, 1]
                    or place[body, 2] != before[body, 2]
                )
                if inverse_mass[body] > 0 and away:
                    for axis in range(3):
                        place[body, axis] = before[body, axis]
                    velocity[body, 0], velocity[body, 1], yaw_rate[body] = 0.0, 0.0, 0.0
                    apart = False
        if apart:
            return


@compiled
def _strike(row, i, j, place, velocity, yaw_rate, inverse_mass, inverse_inertia, normal, point):
    """Apply the collision impulse to two boxes that approach each other, and return it [N s]; 0 where they part."""
    x, y = normal[row, 0], normal[row, 1]
    from_i_x, from_i_y = point[row, 0] - place[i, 0], point[row, 1] - place[i, 1]
    from_j_x, from_j_y = point[row, 0] - place[j, 0], point[row, 1] - place[j, 1]
    speed_x = velocity[i, 0] - yaw_rate[i] * from_i_y - velocity[j, 0] + yaw_rate[j] * from_j_y
    speed_y = velocity[i, 1] + yaw_rate[i] * from_i_x - velocity[j, 1] - yaw_rate[j] * from_j_x
    towards = speed_x * x + speed_y * y
    if towards >= 0:
        return 0.0
    lever_i = from_i_x * y - from_i_y * x
    lever_j = from_j_x * y - from_j_y * x
    give = inverse_mass[i] + inverse_mass[j] + lever_i**2 * inverse_inertia[i] + lever_j**2 * inverse_inertia[j]
    size = -(1 + RESTITUTION) * towards / give
    velocity[i, 0] += size * inverse_mass[i] * x
    velocity[i, 1] += size * inverse_mass[i] * y
    velocity[j, 0] -= size * inverse_mass[j] * x
    velocity[j, 1] -= size * inverse_mass[j] * y
    yaw_rate[i] += size * inverse_inertia[i] * lever_i
    yaw_rate[j] -= size * inverse_inertia[j] * lever_j
    return size
