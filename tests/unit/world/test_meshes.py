import numpy as np
import pytest

from flcav.geometry import pose
from flcav.world.materials import OPTICS, Material
from flcav.world.meshes import MAKERS, actor_mesh
from flcav.world.rays.embree import Solid
from flcav.world.shapes import SHAPES
from flcav.world.trace import CATEGORIES

EVERY_SHAPE = [(category, index) for category in SHAPES for index in range(len(SHAPES[category]))]
UNUSUAL = ("overturned", "box_van")  # one lies on its side, the other is built as a truck is
CARS = [(kind, row) for kind, row in EVERY_SHAPE if kind in ("car", "van") and SHAPES[kind][row].name not in UNUSUAL]


def parallel_hits(category: str, index: int, along: int, steps: int = 60):
    """Return what parallel rays through the shape's box meet, towards negative x, y or z, and where they start."""
    mesh = actor_mesh(category, index)
    solid = Solid(mesh.vertices, mesh.faces)
    low, high = mesh.bounds()
    aside = [axis for axis in range(3) if axis != along]
    grid = [np.linspace(low[axis], high[axis], steps + 2)[1:-1] for axis in aside]
    first, second = (values.ravel() for values in np.meshgrid(*grid, indexing="ij"))
    direction = np.zeros((1, 3), np.float32)
    direction[0, along] = -1
    faces = []
    for u, v in zip(first, second):
        origin = np.empty(3)
        origin[aside[0]], origin[aside[1]], origin[along] = u, v, high[along] + 1
        faces.append(solid.trace(pose(*origin), direction).face[0])
    return np.array(faces), first, second


@pytest.mark.parametrize(("category", "index"), EVERY_SHAPE)
def test_has_exactly_its_outer_dimensions(category: str, index: int):
    shape = SHAPES[category][index]
    low, high = actor_mesh(category, index).bounds()
    np.testing.assert_allclose(high - low, shape[1:], atol=1e-4)
    np.testing.assert_allclose(low, (-shape.length / 2, -shape.width / 2, 0), atol=1e-4)


@pytest.mark.parametrize(("category", "index"), EVERY_SHAPE)
def test_is_built_near_those_dimensions(category: str, index: int):
    """The final stretch only trims: no shape is distorted by it (children are small grown-ups)."""
    if (category, index) == ("pedestrian", 2):
        return
    low, high = MAKERS[category](SHAPES[category][index]).bounds()
    np.testing.assert_allclose(high - low, SHAPES[category][index][1:], rtol=0.15)


@pytest.mark.parametrize(("category", "index"), EVERY_SHAPE)
def test_triangles_are_sound(category: str, index: int):
    mesh = actor_mesh(category, index)
    assert 400 <= len(mesh.faces) <= 2800
    assert mesh.faces.min() == 0
    assert mesh.faces.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
    assert set(np.unique(mesh.material)) <= set(Material)
    lengths = np.linalg.norm(mesh.normals(), axis=1)
    assert ((np.abs(lengths - 1) < 1e-4) | (lengths < 1e-4)).all()


@pytest.mark.parametrize(("category", "index"), CARS)
def test_cars_have_their_parts(category: str, index: int):
    mesh = actor_mesh(category, index)
    parts = {Material(material) for material in np.unique(mesh.material)}
    wanted = "PAINT GLASS TYRE RIM HEADLAMP TAILLAMP PLATE TRIM INTERIOR SKIN CLOTH"
    assert parts >= {Material[name] for name in wanted.split()}
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    assert (
        centers[mesh.material == Material.HEADLAMP, 0].min() > 0 > centers[mesh.material == Material.TAILLAMP, 0].max()
    )
    tyres = mesh.vertices[mesh.faces[mesh.material == Material.TYRE]].reshape(-1, 3)
    assert tyres[:, 2].min() == pytest.approx(0, abs=1e-4)
    assert all(((np.sign(tyres[:, :2]) == corner).all(axis=1)).any() for corner in [(1, 1), (1, -1), (-1, 1), (-1, -1)])


def test_car_has_no_holes_seen_from_the_side():
    faces, x, z = parallel_hits("car", 3, along=1)
    shape = SHAPES["car"][3]
    door = (np.abs(x) < 0.20 * shape.length) & (z > 0.2) & (z < 0.55 * shape.height)
    assert door.sum() > 100
    assert (faces[door] >= 0).all()
    assert 0.6 < (faces >= 0).mean() < 0.95  # and the silhouette is a car's, no box's


def test_car_has_no_holes_seen_from_above():
    faces, _, y = parallel_hits("car", 3, along=2)
    inner = np.abs(y) < 0.38 * SHAPES["car"][3].width
    assert (faces[inner] >= 0).all()


def test_pickup_has_an_open_bed():
    """Above the rear axle the ray goes down to the bed's floor, well below its walls."""
    mesh = actor_mesh("car", 8)
    shape = SHAPES["car"][8]
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    hits = Solid(mesh.vertices, mesh.faces).trace(pose(-0.3 * shape.length, 0.0, 5.0), down)
    assert 5.0 - hits.distance[0] < 0.40 * shape.height


def test_taxi_sign_is_its_highest_part():
    mesh = actor_mesh("car", 9)
    highest = mesh.vertices[mesh.faces][:, :, 2].max(axis=1) > mesh.vertices[:, 2].max() - 1e-4
    assert set(mesh.material[highest]) == {Material.SIGN}


def test_every_category_and_material_is_known():
    assert set(MAKERS) == set(CATEGORIES) == set(SHAPES)
    assert set(OPTICS) == set(Material)
    assert all(0 < optics.reflectivity <= 1 for optics in OPTICS.values())


@pytest.mark.parametrize("shape", [1, 3, 6])
def test_bowed_ends_keep_the_box_and_draw_in_its_corners(shape: int):
    size = SHAPES["car"][shape][1:]
    flat, bowed = actor_mesh("car", shape, size), actor_mesh("car", shape, (*size, 0.4))
    np.testing.assert_allclose(bowed.bounds(), flat.bounds(), atol=1e-5)
    drawn_in = np.abs(flat.vertices[:, 0]) - np.abs(bowed.vertices[:, 0])
    assert (drawn_in >= -1e-6).all()
    ends = np.abs(flat.vertices[:, 0]) > size[0] / 2 - 0.01
    side = np.abs(flat.vertices[:, 1]) / (size[1] / 2)
    np.testing.assert_allclose(drawn_in[ends], 0.4 * side[ends] ** 3, atol=0.02)
    assert drawn_in[ends].max() > 0.15
    assert (drawn_in[np.abs(flat.vertices[:, 0]) < size[0] / 2 - 0.6] < 1e-6).all()
