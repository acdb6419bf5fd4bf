import importlib.util
from typing import Any

import numba
import numba.core.caching
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.geometry import inverse, pose, transform_points
from flcav.machine.compiled import compiled
from flcav.world.rays.embree import Assembly, Solid, embree_library
from flcav.world.rays.packets import MISS, trace_packets

FORWARD = np.array([[1.0, 0.0, 0.0]], np.float32)


def soup(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random triangles about the origin."""
    corners = rng.uniform(-3, 3, (count, 1, 3)) + rng.uniform(-1, 1, (count, 3, 3))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.standard_normal((count, 3))
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def brute_force(origin: np.ndarray, rays: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (rays, triangles) distances by Moeller and Trumbore's formula; inf where a triangle is missed."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    p = np.cross(rays[:, None], (c - a)[None])
    determinant = (p * (b - a)).sum(-1)
    s = origin - a
    u = (s * p).sum(-1) / determinant
    q = np.cross(s, b - a)
    v = (rays[:, None] * q).sum(-1) / determinant
    t = (q * (c - a)).sum(-1) / determinant
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_matches_brute_force(seed: int):
    rng = np.random.default_rng(seed)
    soups = [soup(rng, 20), soup(rng, 30)]
    places = [pose(*rng.uniform(-6, 6, 3), *rng.uniform(-3, 3, 3)) for _ in soups]
    assembly = Assembly([Solid(*one) for one in soups])
    for instance, place in enumerate(places):
        assembly.place(instance, place)
    assembly.commit()
    eye = pose(*rng.uniform(-6, 6, 3), *rng.uniform(-3, 3, 3))
    rays = directions(rng, 100)
    hits = assembly.trace(eye, rays)

    world_rays = rays.astype(float) @ eye[:3, :3].T
    corners = [
        transform_points(place, vertices.astype(float))[faces] for place, (vertices, faces) in zip(places, soups)
    ]
    expected = brute_force(eye[:3, 3], world_rays, np.concatenate(corners))
    nearest = expected.argmin(axis=1)
    distance = expected.min(axis=1)
    # a ray that grazes an edge may go either way in float32: two of the hundred may
    agree = np.isclose(hits.distance, distance, atol=1e-3) | (np.isinf(hits.distance) & np.isinf(distance))
    assert (~agree).sum() <= 2
    met = agree & np.isfinite(distance)
    assert (hits.instance[met] != (nearest[met] >= 20)).sum() <= 2
    assert (hits.face[met] != np.where(nearest[met] >= 20, nearest[met] - 20, nearest[met])).sum() <= 2
    assert (hits.instance[np.isinf(hits.distance)] == MISS).all()


def test_solid_alone_matches_the_placed_one():
    rng = np.random.default_rng(0)
    solid = Solid(*soup(rng, 60))
    place, eye, rays = pose(20.0, -3.0, 1.0, yaw=0.7), pose(15.0, -3.0, 0.0, yaw=-0.4), directions(rng, 501)
    assembly = Assembly([solid])
    assembly.place(0, place)
    assembly.commit()
    placed = assembly.trace(eye, rays)
    alone = solid.trace(inverse(place) @ eye, rays)
    assert (placed.face == alone.face).mean() > 0.99
    same = (placed.face == alone.face) & (alone.face != MISS)
    assert same.sum() > 20
    np.testing.assert_allclose(placed.distance[same], alone.distance[same], atol=1e-3)


def wall(x: float) -> Solid:
    vertices = np.array([[x, -5, -5], [x, 5, -5], [x, 0, 8]], np.float32)
    return Solid(vertices, np.array([[0, 1, 2]], np.int32))


def test_moves_hides_and_comes_back():
    assembly = Assembly([wall(2.0), wall(6.0)])
    assert assembly_after(assembly, None, np.eye(4)) == pytest.approx((6.0, 1))
    assert assembly_after(assembly, np.eye(4), np.eye(4)) == pytest.approx((2.0, 0))
    assert assembly_after(assembly, pose(1.0, 0.0), None) == pytest.approx((3.0, 0))
    assert assembly_after(assembly, None, None) == (np.inf, MISS)


def assembly_after(assembly: Assembly, first: np.ndarray | None, second: np.ndarray | None) -> tuple[float, int]:
    assembly.place(0, first)
    assembly.place(1, second)
    assembly.commit()
    hits = assembly.trace(np.eye(4), FORWARD)
    return float(hits.distance[0]), int(hits.instance[0])


def test_near_and_far_bound_the_ray():
    assembly = Assembly([wall(2.0), wall(6.0)])
    for instance in (0, 1):
        assembly.place(instance, np.eye(4))
    assembly.commit()
    rays = np.repeat(FORWARD, 3, axis=0)
    hits = assembly.trace(np.eye(4), rays, near_m=np.array([0.0, 2.5, 6.5], np.float32))
    assert hits.distance.tolist() == pytest.approx([2.0, 6.0, np.inf])
    assert np.isinf(assembly.trace(np.eye(4), rays, far_m=1.9).distance).all()
    with pytest.raises(ValueError, match="2 values for 3 rays"):
        assembly.trace(np.eye(4), rays, near_m=np.zeros(2, np.float32))


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 1000])
def test_threads_and_packets_change_nothing(count: int):
    rng = np.random.default_rng(count)
    solid = Solid(*soup(rng, 200))
    rays = directions(rng, count)
    whole = solid.trace(pose(0.0, 8.0), rays)
    split = solid.trace(pose(0.0, 8.0), rays, threads=2)
    single = [solid.trace(pose(0.0, 8.0), rays[i : i + 1]).face[0] for i in range(0, count, 97)]
    np.testing.assert_array_equal(whole.distance, split.distance)
    np.testing.assert_array_equal(whole.face, split.face)
    assert whole.face[::97].tolist() == single


def test_empty_mesh_is_refused():
    with pytest.raises(ValueError, match="at least one face"):
        Solid(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def test_says_where_there_is_no_library(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(OSError, match=r"embreex is not installed .* aarch64"):
        embree_library.__wrapped__()


def test_compiled_code_is_kept_on_disk():
    Solid(*soup(np.random.default_rng(0), 5)).trace(np.eye(4), FORWARD)
    stats: Any = trace_packets.stats  # pyright: ignore[reportFunctionMemberAccess]
    assert sum(stats.cache_hits.values()) + sum(stats.cache_misses.values()) > 0


def test_compiles_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    assert compiled(lambda x: x + 1)(2) == 3
