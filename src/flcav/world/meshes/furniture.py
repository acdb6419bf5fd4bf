"""Meshes of trees, street furniture and barriers, with the origin at the foot: signals, signs, lamps, hedges, fences.

Crowns of trees are loose leaves, so that some rays pass between them. Barriers and clutter measure `length` along x,
`width` along y and `height` along z [m].
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from flcav.arrays import Array
from flcav.statistics.streams import stream
from flcav.world.materials import Material
from flcav.world.meshes.bodywork import wheel
from flcav.world.meshes.mesh import (
    Mesh,
    add_mirror_image,
    box,
    ellipsoid,
    fit_to_size,
    join_meshes,
    sheet,
    transform_mesh,
    tube,
)
from flcav.world.meshes.people import bicycle, motorcycle
from flcav.world.shapes import SHAPES

UNEVEN = 0.12  # standard deviation of foliage's surface, over its half extent
LEAVES_PER_M2 = 14.0  # loose clusters of leaves on a surface of foliage
LEAF_M = 0.16  # size of such a cluster
PICKET_M, BAR_M = 0.16, 0.13  # from one picket, or bar, to the next
BICYCLE_M, POST_M = 0.55, 2.0  # from one bicycle of a rack to the next, and from one post of a guard rail


def make_hedgerow(length: float, width: float, height: float) -> Mesh:
    """Return a hedge of these dimensions [m], with an uneven surface and loose leaves around it."""
    rng = stream(0, "hedgerow", *(round(1000 * size) for size in (length, width, height)))
    along = np.linspace(-0.5, 0.5, max(2, round(length / 0.5)) + 1)
    around = np.array(((-0.5, 0.0), (-0.5, 0.5), (-0.42, 0.9), (0.0, 1.0), (0.42, 0.9), (0.5, 0.5), (0.5, 0.0)))
    grid = np.empty((len(along), len(around), 3))
    grid[..., 0] = along[:, None]
    grid[..., 1:] = around
    return _leafy(grid, (length, width, height), rng)


def make_shrub(length: float, width: float, height: float) -> Mesh:
    """Return a shrub of these dimensions [m]: an uneven dome with loose leaves around it."""
    rng = stream(0, "shrub", *(round(1000 * size) for size in (length, width, height)))
    polar, azimuth = np.linspace(0, 0.55 * np.pi, 5)[:, None], np.linspace(0, 2 * np.pi, 10)[None]
    dome = (np.sin(polar) * np.cos(azimuth) / 2, np.sin(polar) * np.sin(azimuth) / 2, np.cos(polar) + 0 * azimuth)
    grid = np.stack(dome, axis=2)
    grid[..., 2] = (grid[..., 2] + 0.16) / 1.16
    return _leafy(grid, (length, width, height), rng, closed=True)


def make_wall(length: float, width: float, height: float) -> Mesh:
    """Return a garden wall of these dimensions [m], with its coping."""
    body = box((0, 0, 0.46 * height), (length, 0.8 * width, 0.92 * height), Material.WALL)
    return join_meshes((body, box((0, 0, 0.96 * height), (length, width, 0.08 * height), Material.SIDEWALK)))


def make_fence(length: float, width: float, height: float) -> Mesh:
    """Return a wooden picket fence of these dimensions [m]: gaps between the pickets, two rails behind them."""
    return _barrier(length, width, height, PICKET_M, 0.6, Material.BARK)


def make_railing(length: float, width: float, height: float) -> Mesh:
    """Return a metal railing of these dimensions [m]: thin bars between two rails."""
    return _barrier(length, width, height, BAR_M, 0.18, Material.METAL)


def make_bin(length: float, width: float, height: float) -> Mesh:
    """Return a wheeled bin of these dimensions [m], with its lid."""
    body = box((0, 0, 0.47 * height), (0.85 * length, 0.85 * width, 0.9 * height), Material.TRIM)
    return join_meshes((body, box((0, 0, 0.96 * height), (length, width, 0.08 * height), Material.RIM)))


def make_post(length: float, width: float, height: float) -> Mesh:
    """Return a round post or bollard of these dimensions [m]."""
    return fit_to_size(tube((0, 0, 0), (0, 0, 1), 0.5, Material.METAL, sides=8), length, width, height)


def make_rack(length: float, width: float, height: float) -> Mesh:
    """Return bicycles without riders in a rack of these dimensions [m], across its `length`, every fifth place empty.

    A rack with room for one is a single bicycle, along x.
    """
    shape = SHAPES["bicycle"][0]
    one = bicycle(shape, ridden=False)
    if length < 2 * shape.length:
        return fit_to_size(one, length, width, height)
    rng = stream(0, "rack", *(round(1000 * size) for size in (length, width, height)))
    places = np.linspace(-0.5, 0.5, max(3, round(length / BICYCLE_M))) * length
    taken = [x for number, x in enumerate(places.tolist()) if number in (0, len(places) - 1) or rng.random() > 0.2]
    parts = [transform_mesh(one, x, rng.uniform(-0.12, 0.12), 0.0, np.pi / 2 + rng.normal(0, 0.06)) for x in taken]
    rail = box((0, 0.3, 0.45), (length, 0.05, 0.05), Material.METAL)
    return fit_to_size(join_meshes((*parts, rail)), length, width, height)


def make_motorbike(length: float, width: float, height: float) -> Mesh:
    """Return a parked motorcycle of these dimensions [m]."""
    return fit_to_size(motorcycle(SHAPES["motorcycle"][0], ridden=False), length, width, height)


def make_trailer(length: float, width: float, height: float) -> Mesh:
    """Return a parked car trailer of these dimensions [m]: a tarpaulin on boards, one axle, and a drawbar ahead."""
    bed = 0.72 * length
    rear = -length / 2
    middle = rear + bed / 2
    floor = min(0.5, 0.4 * height)
    parts = [
        box((middle, 0, floor), (bed, 0.84 * width, 0.1), Material.TRIM),
        box((middle, 0, floor + 0.15 * height), (bed, 0.84 * width, 0.3 * height), Material.METAL),
        box((middle, 0, (floor + height) / 2 + 0.1), (0.96 * bed, 0.8 * width, height - floor - 0.2), Material.CLOTH),
        box(((rear + bed + length / 2) / 2, 0, floor), (length - bed, 0.08, 0.08), Material.METAL),
        add_mirror_image(transform_mesh(wheel(0.29, 0.16), middle, width / 2 - 0.08)),
    ]
    return fit_to_size(join_meshes(parts), length, width, height)


def make_guard_rail(length: float, width: float, height: float) -> Mesh:
    """Return a guard rail of these dimensions [m]: a corrugated beam before posts."""
    waves = ((0.0, 1.0), (0.5, 0.86), (0.0, 0.72), (0.5, 0.58), (0.0, 0.44))
    rows = [[(x, width * (0.5 - depth), height * top) for depth, top in waves] for x in (-length / 2, length / 2)]
    count = max(2, round(length / POST_M))
    posts = [
        box((x, -0.3 * width, 0.4 * height), (0.06, 0.4 * width, 0.8 * height), Material.METAL)
        for x in ((np.arange(count) - (count - 1) / 2) * length / count).tolist()
    ]
    return fit_to_size(join_meshes((sheet(rows, Material.METAL), *posts)), length, width, height)


def _barrier(length: float, width: float, height: float, pitch_m: float, full: float, material: Material) -> Mesh:
    """Return upright slats with a width of `full` times the pitch, and two rails at 20 % and 85 % of the height."""
    count = max(2, round(length / pitch_m))
    step = length / count
    front = (np.arange(count) - (count - 1) / 2) * step
    parts = [
        sheet(
            [[(x - side, width / 2, z) for side in (-full * step / 2, full * step / 2)] for z in (0, height)], material
        )
        for x in front.tolist()
    ]
    rails = [box((0, 0, share * height), (length, width, 0.06), material) for share in (0.2, 0.85)]
    return join_meshes((*parts, *rails))


def _leafy(grid: Array, size: tuple[float, float, float], rng: np.random.Generator, closed: bool = False) -> Mesh:
    """Return a foliage mesh of this `size` [m]: the roughened surface through a unit grid (A, B, 3), and loose leaves.

    With `closed` the last column of the grid joins the first.
    """
    uneven = 1 + UNEVEN * rng.standard_normal((*grid.shape[:2], 1)).clip(-2, 2)
    if closed:
        uneven[:, -1] = uneven[:, 0]
        uneven[0] = uneven[0, 0]
    points = grid * np.asarray(size) * np.concatenate((uneven, uneven, uneven), axis=2)
    points[..., 0] += grid[..., 0] * np.asarray(size)[0] * (1 - uneven[..., 0]) * (not closed)  # ends stay in place
    length, width, height = size
    surface = fit_to_size(sheet(points, Material.LEAF), length, width, height)
    count = round(LEAVES_PER_M2 * (length * width + 2 * height * (length + width)))
    at = surface.vertices[rng.integers(len(surface.vertices), size=count)] + rng.normal(0, 0.15, (count, 3))
    corners = (at[:, None] + rng.normal(0, LEAF_M / 2, (count, 3, 3))).reshape(-1, 3)
    corners = corners.clip((-length / 2, -width / 2, 0), (length / 2, width / 2, height)).astype(np.float32)
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return join_meshes((surface, Mesh(corners, faces, np.full(count, Material.LEAF, np.uint8))))


MAKERS: Mapping[str, Callable[[float, float, float], Mesh]] = {
    "hedgerow": make_hedgerow,
    "shrub": make_shrub,
    "wall": make_wall,
    "fence": make_fence,
    "railing": make_railing,
    "bin": make_bin,
    "bollard": make_post,
    "post": make_post,
    "rack": make_rack,
    "bicycle": make_rack,
    "motorbike": make_motorbike,
    "trailer": make_trailer,
    "guard_rail": make_guard_rail,
}


LEAVES = 360  # triangles of a crown; each stands for a cluster of leaves
LEAF = 0.38  # size of a cluster over the crown's radius: the crown stops about two rays in three
HEAD_M = (0.20, 0.36, 1.04)  # depth, width, height of the housing of three lenses; one fewer takes its pitch off
LENS_RADIUS_M = 0.125
LENS_PITCH_M = 0.32  # between the centres of neighbouring lenses
VISOR_M = 0.20  # length of a visor
LIGHT_MAST_BEHIND_M = 0.22  # from the head's centre back to its mast
SIGNAL_LENSES = {  # kind of signal head -> its lenses and their places, in pitches above the head's centre
    "signal": ((Material.LENS_RED, 1.0), (Material.LENS_AMBER, 0.0), (Material.LENS_GREEN, -1.0)),
    "walker_signal": ((Material.LENS_RED, 0.5), (Material.LENS_GREEN, -0.5)),
}
SIGN_RADIUS_M = 0.36  # circumscribed radius of a sign's plate
MAST_BEHIND_M = 0.40  # from a roadside sensor back to its mast


def make_tree(height: float, crown_radius: float, rng: np.random.Generator) -> Mesh:
    """Return the mesh of a tree of this height and crown radius [m], origin at its foot; `rng` draws the leaves."""
    crown_foot = 0.32 * height
    middle = np.array((0.0, 0.0, (height + crown_foot) / 2))
    radii = np.array((crown_radius, crown_radius, (height - crown_foot) / 2))
    trunk = tube((0, 0, 0), middle, 0.05 + 0.018 * height, Material.BARK, end_radius=0.05, sides=6, capped=False)
    return join_meshes((trunk, scatter_leaves(middle, radii, LEAVES, LEAF * crown_radius, rng)))


def scatter_leaves(center: ArrayLike, radii: ArrayLike, count: int, size_m: float, rng: np.random.Generator) -> Mesh:
    """Return `count` loose triangles of about `size_m` in an ellipsoid, densest towards its surface.

    `center` (3,) and half axes `radii` (3,) are in metres; the triangles have random orientations.
    """
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inside = 1 - size_m / 2 / np.min(radii)
    place = np.asarray(center) + direction * rng.random((count, 1)) ** 0.2 * np.asarray(radii) * inside
    corners = rng.standard_normal((count, 3, 3))
    corners *= size_m / 2 / np.linalg.norm(corners, axis=2, keepdims=True)
    vertices = (place[:, None] + corners).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3), np.full(count, Material.LEAF, np.uint8))


def signal_head(kind: str, height: float) -> Mesh:
    """Return the mesh of a signal head of a kind of `SIGNAL_LENSES`, facing +x, `height` [m] above the origin."""
    front = HEAD_M[0] / 2
    lenses = SIGNAL_LENSES[kind]
    housing = (*HEAD_M[:2], HEAD_M[2] - (3 - len(lenses)) * LENS_PITCH_M)
    parts = [box((0, 0, height), housing, Material.TRIM)]
    for material, place in lenses:
        middle = np.array((front + 0.005, 0.0, height + place * LENS_PITCH_M))
        parts += [_lens(middle, material), _visor(middle)]
    return join_meshes(parts)


def map_pole(height: float) -> Mesh:
    """Return a plain pole `height` [m] tall above the origin."""
    return tube((0, 0, 0), (0, 0, height), 0.04, Material.METAL, sides=8)


def signal_mast(height: float, reach: float = 0.0) -> Mesh:
    """Return the mast of a signal head `height` [m] above the origin; with `reach` [m], on an arm to the left."""
    foot = np.array((-LIGHT_MAST_BEHIND_M, 0.0, 0.0))
    top = np.array((-LIGHT_MAST_BEHIND_M, 0.0, height + 0.25))
    mast = tube(foot, top, 0.075, Material.METAL, sides=8)
    bracket = box((-LIGHT_MAST_BEHIND_M / 2 - 0.04, reach, height), (LIGHT_MAST_BEHIND_M, 0.08, 0.08), Material.METAL)
    if not reach:
        return join_meshes((mast, bracket))
    arm = tube(
        (-LIGHT_MAST_BEHIND_M, 0, height),
        (-LIGHT_MAST_BEHIND_M, reach, height),
        0.06,
        Material.METAL,
        end_radius=0.04,
        sides=6,
    )
    return join_meshes((mast, arm, bracket))


def _lens(middle: np.ndarray, material: Material) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 13)
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * LENS_RADIUS_M + middle
    return sheet(np.stack((rim, rim * 0 + middle)), material)


def _visor(middle: np.ndarray) -> Mesh:
    angle = np.linspace(-0.15 * np.pi, 1.15 * np.pi, 9)
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * (LENS_RADIUS_M + 0.015) + middle
    return sheet(np.stack((rim, rim + np.array((VISOR_M, 0, 0)))), Material.TRIM)


def make_clutter(kind: str, length: float, width: float, height: float) -> Mesh:
    """Return a piece of street clutter of these dimensions [m], `length` along x; a box for an unknown kind."""
    return CLUTTER.get(kind, _box)(length, width, height)


def make_lamp(height: float) -> Mesh:
    """Return a street lamp of this height [m]; the underside of its head is luminous."""
    post = tube((0, 0, 0), (0, 0, height), 0.08, Material.METAL, end_radius=0.05, sides=6)
    head = box((0, 0, height), (0.9, 0.9, 0.12), Material.METAL)
    head.material[head.vertices[head.faces, 2].max(axis=1) < height] = Material.LAMP
    return join_meshes((post, head))


def sensor_mast(height: float) -> Mesh:
    """Return the mast of a roadside sensor that is `height` [m] above the origin and faces +x."""
    mast = tube((-MAST_BEHIND_M, 0, 0), (-MAST_BEHIND_M, 0, height + 0.1), 0.09, Material.METAL, sides=8)
    arm = box((-MAST_BEHIND_M / 2 - 0.06, 0, height - 0.12), (MAST_BEHIND_M - 0.12, 0.06, 0.06), Material.METAL)
    return join_meshes((mast, arm))


def sign_plate(kind: str, height: float) -> Mesh:
    """Return the plate of a traffic sign, front and back: an octagon for stop, a triangle for yield, else a disc.

    Its centre is `height` [m] above the origin; it faces +x.
    """
    corners, start = {"stop": (8, np.pi / 8), "yield": (3, -np.pi / 2)}.get(kind, (16, 0.0))
    angle = start + np.arange(corners + 1) * 2 * np.pi / corners
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * SIGN_RADIUS_M
    plates = []
    for x, material in ((0.0, Material.SIGN), (-0.01, Material.METAL)):
        vertices = np.concatenate((rim[:-1], np.zeros((1, 3)))) + np.array((x, 0.0, height))
        index = np.arange(corners)
        faces = np.stack((index, (index + 1) % corners, np.full(corners, corners)), axis=1)
        plates.append(Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.full(corners, material, np.uint8)))
    return join_meshes(plates)


def sign_post(height: float) -> Mesh:
    """Return the post behind the plate of a traffic sign that is `height` [m] above the origin."""
    return tube((-0.05, 0, 0), (-0.05, 0, height + 0.2), 0.035, Material.METAL, sides=6)


def _box(length: float, width: float, height: float) -> Mesh:
    return box((0, 0, height / 2), (length, width, height), Material.METAL)


def _hedge(length: float, width: float, height: float) -> Mesh:
    return box((0, 0, height / 2), (length, width, height), Material.LEAF)


def _bins(length: float, width: float, height: float) -> Mesh:
    count = max(1, round(length / 0.8))
    step = length / count
    parts = []
    for x in (np.arange(count) - (count - 1) / 2) * step:
        parts.append(box((x, 0, 0.46 * height), (step * 0.85, width * 0.85, 0.92 * height), Material.TRIM))
        parts.append(box((x, 0, 0.95 * height), (step * 0.9, width, 0.10 * height), Material.METAL))
    return join_meshes(parts)


def _planter(length: float, width: float, height: float) -> Mesh:
    tub = box((0, 0, 0.25 * height), (length, width, 0.5 * height), Material.WALL)
    bush = ellipsoid((0, 0, 0.55 * height), (0.46 * length, 0.45 * width, 0.45 * height), Material.LEAF)
    return join_meshes((tub, bush))


def _kiosk(length: float, width: float, height: float) -> Mesh:
    body = box((0, 0, 0.45 * height), (0.88 * length, 0.85 * width, 0.9 * height), Material.WALL)
    roof = box((0, 0, 0.95 * height), (length, width, 0.1 * height), Material.ROOF)
    counter = box((0, 0.45 * width, 0.45 * height), (0.6 * length, 0.1 * width, 0.05 * height), Material.METAL)
    return join_meshes((body, roof, counter))


def _shelter(length: float, width: float, height: float) -> Mesh:
    parts = [box((0, 0, height - 0.06), (length, width, 0.12), Material.ROOF)]
    parts.append(box((0, -width / 2 + 0.03, 0.55 * height), (0.96 * length, 0.02, 0.75 * height), Material.GLASS))
    parts.append(box((-length / 2 + 0.03, 0, 0.55 * height), (0.02, 0.8 * width, 0.75 * height), Material.GLASS))
    parts.append(box((0, -width / 4, 0.45), (0.7 * length, 0.4, 0.06), Material.METAL))
    for x in (-length / 2 + 0.05, length / 2 - 0.05):
        for y in (-width / 2 + 0.05, width / 2 - 0.05):
            parts.append(box((x, y, height / 2 - 0.06), (0.08, 0.08, height - 0.12), Material.METAL))
    return join_meshes(parts)


def _container(length: float, width: float, height: float) -> Mesh:
    body = box((0, 0, 0.44 * height), (0.94 * length, 0.94 * width, 0.8 * height), Material.METAL)
    lid = box((0, 0, 0.92 * height), (length, width, 0.16 * height), Material.TRIM)
    return join_meshes((body, lid))


CLUTTER: dict[str, Callable[[float, float, float], Mesh]] = {
    "hedge": _hedge,
    "bins": _bins,
    "planter": _planter,
    "kiosk": _kiosk,
    "shelter": _shelter,
    "container": _container,
    "cabinet": _box,
    **MAKERS,
}
