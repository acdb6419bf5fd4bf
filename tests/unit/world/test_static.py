from collections.abc import Callable

import numpy as np
import pytest

from flcav.geometry import pose
from flcav.world.map.parameters import CLUTTER as PLACED_CLUTTER
from flcav.world.map.town import TOWNS, Poles, Signs, Town, load_town
from flcav.world.materials import Material
from flcav.world.meshes.furniture import CLUTTER, make_clutter
from flcav.world.meshes.mesh import Mesh
from flcav.world.rays.embree import Solid
from flcav.world.static import GROUND_M, KERB_M, build_town_mesh


def look(mesh: Mesh, origin: tuple[float, float, float], direction: tuple[float, float, float]):
    """Return the distance to the first surface and its material."""
    unit = np.array([direction], np.float32) / np.float32(np.linalg.norm(direction))
    hits = Solid(mesh.vertices, mesh.faces).trace(pose(*origin), unit)
    met = hits.face[0] >= 0
    return float(hits.distance[0]), Material(mesh.material[hits.face[0]]) if met else None


def height(mesh: Mesh, x: float, y: float) -> tuple[float, Material | None]:
    distance, material = look(mesh, (x, y, 100.0), (0, 0, -1))
    return 100.0 - distance, material


def test_ground_road_and_raised_sidewalk(small_town: Callable[..., Town]):
    mesh = build_town_mesh(small_town())
    assert height(mesh, 3.3, 2.1) == (pytest.approx(0.0, abs=1e-4), Material.ROAD)
    assert height(mesh, 3.3, 8.1) == (pytest.approx(KERB_M, abs=1e-4), Material.SIDEWALK)
    assert height(mesh, 3.3, -30.0) == (pytest.approx(GROUND_M, abs=1e-4), Material.GROUND)
    distance, material = look(mesh, (3.3, 0.0, KERB_M / 2), (0, 1, 0))
    assert (distance, material) == (pytest.approx(7.0), Material.SIDEWALK)  # the kerb


@pytest.mark.parametrize(("wanted", "top"), [(7.0, 7.0), (14.0, 14.0)])
def test_buildings_are_as_high_as_the_town_says(small_town: Callable[..., Town], wanted: float, top: float):
    mesh = build_town_mesh(small_town(buildings=np.array([[0.0, 30.0, 0.3, 20.0, 12.0, wanted]])))
    heights = [height(mesh, x, 30.0 + 0.31 * x)[0] for x in np.linspace(-3, 3, 13)]
    assert max(heights) == pytest.approx(top, abs=0.1)
    distance, material = look(mesh, (0.4, 0.0, 1.5), (0, 1, 0))
    assert distance == pytest.approx(30.0 - 6.0 / np.cos(0.3), abs=0.3)
    assert material == Material.WALL


def test_rays_partly_pass_a_crown(small_town: Callable[..., Town]):
    tree = np.array([[0.0, -20.0, 8.0, 2.2]])
    mesh = build_town_mesh(small_town(trees=tree))
    xs, zs = (values.ravel() for values in np.meshgrid(np.linspace(-1.2, 1.2, 15), np.linspace(4.0, 6.5, 15)))
    found = [look(mesh, (x, 0.0, z), (0, -1, 0))[1] for x, z in zip(xs, zs)]
    leaves = np.mean([material == Material.LEAF for material in found])
    assert 0.35 < leaves < 0.95
    assert look(mesh, (0.0, 0.0, 1.2), (0, -1, 0))[1] == Material.BARK


def test_sign_faces_where_it_should(small_town: Callable[..., Town]):
    signs = Signs(np.array([[10.0, 0.0, 2.2]]), np.array([np.pi]), ("stop",))
    mesh = build_town_mesh(small_town(signs=signs))
    assert look(mesh, (0.0, 0.1, 2.25), (1, 0, 0)) == (pytest.approx(10.0, abs=0.01), Material.SIGN)
    assert look(mesh, (20.0, 0.1, 2.25), (-1, 0, 0))[1] == Material.METAL


def test_sensor_on_a_pole_looks_ahead_freely(small_town: Callable[..., Town]):
    poles = Poles(np.array([1]), np.array([[0.0, 0.0, 6.0]]), np.array([0.5]), ("straight",))
    mesh = build_town_mesh(small_town(poles=poles))
    for turn in np.linspace(-2.5, 2.5, 21):
        direction = (np.cos(0.5 + turn), np.sin(0.5 + turn), -0.2)
        assert look(mesh, (0.0, 0.0, 6.0), direction)[1] != Material.METAL
    assert look(mesh, (0.0, 0.0, 6.0), (-np.cos(0.5), -np.sin(0.5), 0.0))[1] == Material.METAL


@pytest.mark.parametrize("kind", [*CLUTTER, "something_new"])
def test_clutter_fills_its_box(kind: str):
    low, high = make_clutter(kind, 3.0, 1.2, 2.0).bounds()
    assert (low > (-1.51, -0.61, -0.01)).all()
    assert (high < (1.51, 0.61, 2.01)).all()
    np.testing.assert_allclose(high - low, (3.0, 1.2, 2.0), rtol=0.12)


def test_every_kind_of_clutter_has_a_mesh():
    assert set(PLACED_CLUTTER) <= set(CLUTTER)


@pytest.mark.parametrize("name", TOWNS)
def test_authored_towns_are_small_and_repeatable(name: str):
    town = load_town(name)
    mesh = build_town_mesh(town)
    again = build_town_mesh(load_town(name))
    assert 20_000 < len(mesh.faces) < 300_000
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    np.testing.assert_array_equal(mesh.faces, again.faces)
    assert np.isfinite(mesh.vertices).all()
