"""Hedges, fences and the like: what share of the rays they stop."""

import numpy as np
import pytest

from flcav.world.materials import Material
from flcav.world.meshes import furniture
from flcav.world.meshes.mesh import Mesh
from flcav.world.rays.embree import Assembly, Solid


def stopped(mesh: Mesh, low: float, high: float) -> float:
    """Return the share of level rays towards a barrier of 4 m that it stops, between two heights [m]."""
    assembly = Assembly([Solid(mesh.vertices, mesh.faces)])
    assembly.place(0, np.eye(4))
    assembly.commit()
    x, z = np.meshgrid(np.linspace(-1.95, 1.95, 301), np.linspace(low, high, 7))
    found = []
    for from_x, from_z in zip(x.ravel(), z.ravel()):
        pose = np.eye(4)
        pose[:3, 3] = from_x, -5.0, from_z
        found.append(assembly.trace(pose, np.array([[0.0, 1.0, 0.0]], np.float32)).instance[0] >= 0)
    return float(np.mean(found))


@pytest.mark.parametrize(("make", "share"), [(furniture.make_fence, 0.6), (furniture.make_railing, 0.18)])
def test_rays_pass_between_slats(make, share):
    assert stopped(make(4.0, 0.1, 1.0), 0.35, 0.65) == pytest.approx(share, abs=0.04)  # between the rails


def test_rays_do_not_pass_walls_and_hedges():
    assert stopped(furniture.make_wall(4.0, 0.3, 1.0), 0.1, 0.9) == 1.0
    assert stopped(furniture.make_hedgerow(4.0, 0.9, 1.5), 0.1, 0.9) > 0.95


def test_foliage_is_uneven_and_the_same_each_time():
    hedge = furniture.make_hedgerow(4.0, 0.9, 1.5)
    np.testing.assert_array_equal(hedge.vertices, furniture.make_hedgerow(4.0, 0.9, 1.5).vertices)
    assert set(hedge.material.tolist()) == {int(Material.LEAF)}
    sides = hedge.vertices[(hedge.vertices[:, 1] > 0) & (hedge.vertices[:, 2] > 0.3)]
    assert np.std(sides[:, 1]) > 0.05
