"""Contacts of boxes against shapely and the laws of conservation."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.world.dynamics.contacts import RESTITUTION, Footprints, find_overlaps, resolve_contacts
from flcav.world.map.surfaces import make_footprint


def boxes(rows: np.ndarray) -> Footprints:
    """Return boxes x, y, yaw, length, width (N, 5), 1 m high."""
    return Footprints(rows[:, :3].copy(), rows[:, 3:] / 2, np.tile((0.0, 1.0), (len(rows), 1)))


def area(a: np.ndarray, b: np.ndarray) -> float:
    return make_footprint(*a).intersection(make_footprint(*b)).area


def draw(seed: int, count: int, spread: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    place = random.uniform((-spread, -spread, -np.pi), (spread, spread, np.pi), (count, 3))
    return np.c_[place, random.uniform((0.3, 0.3), (6.0, 2.5), (count, 2))]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_overlaps_are_those_of_the_polygons(seed: int):
    first, second = draw(seed, 6, 6.0), draw(seed + 1, 6, 6.0)
    found = {tuple(pair) for pair in find_overlaps(boxes(first), boxes(second)).tolist()}
    meets = {(i, j): area(a, b) for i, a in enumerate(first) for j, b in enumerate(second)}
    assert found == {pair for pair, common in meets.items() if common > 1e-9}


def test_boxes_above_each_other_do_not_touch():
    below = boxes(np.array([[0.0, 0, 0, 4, 2]]))
    assert len(find_overlaps(below, below)) == 1
    assert not len(find_overlaps(below, below._replace(level=below.level + 1.5)))


def test_a_head_on_collision_is_that_of_the_textbook():
    rows = np.array([[0.0, 0, 0, 4, 2], [3.9, 0, np.pi, 4, 2]])
    velocity = np.array([[10.0, 0], [-6.0, 0]])
    mass = np.array([1500.0, 3000.0])
    place, after, spin, contacts = resolve_contacts(boxes(rows), rows[:, :3], velocity, np.zeros(2), mass, mass)
    common = mass @ velocity[:, 0] / mass.sum()
    np.testing.assert_allclose(after[:, 0], common - RESTITUTION * (velocity[:, 0] - common))
    np.testing.assert_allclose(after[:, 1], 0, atol=1e-9)
    np.testing.assert_allclose(spin, 0, atol=1e-9)
    assert contacts.impulse == pytest.approx(mass[0] * (velocity[0, 0] - after[0, 0]))
    np.testing.assert_allclose(contacts.normal, [[-1, 0]], atol=1e-12)
    np.testing.assert_allclose(contacts.point[0], (1.95, 0), atol=1e-12)
    assert place[1, 0] - place[0, 0] == pytest.approx(4.0, abs=1e-5)
    assert (place[0, 0] - 0.0) / (place[1, 0] - 3.9) == pytest.approx(-2.0)  # the lighter one is moved aside more


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_collisions_keep_momentum_and_lose_energy(seed: int):
    random = np.random.default_rng(seed)
    rows = np.array([[0.0, 0, 0, 4.5, 2], [*random.uniform((2, -1), (3.5, 1)), random.uniform(-3, 3), 4.5, 2]])
    velocity, spin = random.uniform(-10, 10, (2, 2)), random.uniform(-1, 1, 2)
    mass = random.uniform(1000, 4000, 2)
    inertia = 2 * mass
    place, after, turned, contacts = resolve_contacts(boxes(rows), rows[:, :3], velocity, spin, mass, inertia)
    if (np.abs(place - rows[:, :3]) == 0).all():  # undone
        return
    np.testing.assert_allclose(mass @ after, mass @ velocity, atol=1e-6)
    arms = contacts.point - rows[:, :2]
    assert turned @ inertia + _moment(mass, arms, after) == pytest.approx(
        spin @ inertia + _moment(mass, arms, velocity), rel=1e-9, abs=1e-6
    )

    def energy(v: np.ndarray, w: np.ndarray) -> float:
        return float((mass * (v**2).sum(axis=1) + inertia * w**2).sum())

    assert energy(after, turned) <= energy(velocity, spin) * (1 + 1e-9)


def _moment(mass: np.ndarray, arms: np.ndarray, velocity: np.ndarray) -> float:
    """Return the angular momentum of two middles about the contact, from which the `arms` are measured."""
    return float((mass * -(arms[:, 0] * velocity[:, 1] - arms[:, 1] * velocity[:, 0])).sum())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_nothing_interpenetrates(seed: int):
    random = np.random.default_rng(seed)
    walls = np.array([[0.0, 9, 0, 20, 2], [0, -9, 0, 20, 2], [9, 0, 0, 2, 20], [-9, 0, 0, 2, 20]])
    rows: list[np.ndarray] = []
    for row in draw(seed, 40, 7.0):
        if all(area(row, other) == 0 for other in [*rows, *walls]):
            rows.append(row)
    free = np.array(rows)
    mass = np.concatenate((free[:, 3] * free[:, 4] * 200, np.full(4, np.inf)))
    inertia = np.where(np.isinf(mass), np.inf, 2 * mass)
    count = len(free)
    everything = np.concatenate((free, walls))
    velocity, spin = np.zeros((count + 4, 2)), np.zeros(count + 4)
    velocity[:count], spin[:count] = random.uniform(-15, 15, (count, 2)), random.uniform(-2, 2, count)
    for _ in range(10):
        before = everything[:, :3].copy()
        moved = everything.copy()
        moved[:, :2] += velocity * 0.05
        moved[:, 2] += spin * 0.05
        everything[:, :3], velocity, spin, _ = resolve_contacts(boxes(moved), before, velocity, spin, mass, inertia)
        shapes = np.array([make_footprint(*row) for row in everything])
        first, second = shapely.STRtree(shapes).query(shapes, "intersects")
        apart = (first >= second) | (first >= count)
        assert apart.all() or shapely.area(shapely.intersection(shapes[first], shapes[second]))[~apart].max() < 1e-9
    np.testing.assert_array_equal(everything[count:], walls)
