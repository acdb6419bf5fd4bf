"""Meshes of what stands along real streets: hedges, shrubs, walls, fences, bins, posts, parked bicycles and trailers.

Each is `length` along x, `width` along y and `height` [m], about its foot.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from flcav.statistics.streams import stream
from flcav.world.materials import Material
from flcav.world.meshes.bodywork import wheel
from flcav.world.meshes.mesh import Mesh, add_mirror_image, box, fit_to_size, join_meshes, sheet, transform_mesh, tube
from flcav.world.meshes.people import bicycle, motorcycle
from flcav.world.shapes import SHAPES

UNEVEN = 0.12  # standard deviation of foliage's surface, over its half extent
LEAVES_PER_M2 = 14.0  # loose clusters of leaves on a surface of foliage
LEAF_M = 0.16  # size of such a cluster
PICKET_M, BAR_M = 0.16, 0.13  # from one picket, or bar, to the next
BICYCLE_M, POST_M = 0.55, 2.0  # from one bicycle of a rack to the next, and from one post of a guard rail


def make_hedgerow(length: float, width: float, height: float) -> Mesh:
    """Return a hedge with an uneven surface and loose leaves around it."""
    rng = stream(0, "hedgerow", *(round(1000 * size) for size in (length, width, height)))
    along = np.linspace(-0.5, 0.5, max(2, round(length / 0.5)) + 1)
    around = np.array(((-0.5, 0.0), (-0.5, 0.5), (-0.42, 0.9), (0.0, 1.0), (0.42, 0.9), (0.5, 0.5), (0.5, 0.0)))
    grid = np.empty((len(along), len(around), 3))
    grid[..., 0] = along[:, None]
    grid[..., 1:] = around
    return _leafy(grid, (length, width, height), rng)


def make_shrub(length: float, width: float, height: float) -> Mesh:
    """Return a shrub: an uneven dome with loose leaves around it."""
    rng = stream(0, "shrub", *(round(1000 * size) for size in (length, width, height)))
    polar, azimuth = np.linspace(0, 0.55 * np.pi, 5)[:, None], np.linspace(0, 2 * np.pi, 10)[None]
    dome = (np.sin(polar) * np.cos(azimuth) / 2, np.sin(polar) * np.sin(azimuth) / 2, np.cos(polar) + 0 * azimuth)
    grid = np.stack(dome, axis=2)
    grid[..., 2] = (grid[..., 2] + 0.16) / 1.16
    return _leafy(grid, (length, width, height), rng, closed=True)


def make_wall(length: float, width: float, height: float) -> Mesh:
    """Return a garden wall with its coping."""
    body = box((0, 0, 0.46 * height), (length, 0.8 * width, 0.92 * height), Material.WALL)
    return join_meshes((body, box((0, 0, 0.96 * height), (length, width, 0.08 * height), Material.SIDEWALK)))


def make_fence(length: float, width: float, height: float) -> Mesh:
    """Return a wooden picket fence: gaps between the pickets, two rails behind them."""
    return _barrier(length, width, height, PICKET_M, 0.6, Material.BARK)


def make_railing(length: float, width: float, height: float) -> Mesh:
    """Return a metal railing of thin bars between two rails."""
    return _barrier(length, width, height, BAR_M, 0.18, Material.METAL)


def make_bin(length: float, width: float, height: float) -> Mesh:
    """Return a wheeled bin with its lid."""
    body = box((0, 0, 0.47 * height), (0.85 * length, 0.85 * width, 0.9 * height), Material.TRIM)
    return join_meshes((body, box((0, 0, 0.96 * height), (length, width, 0.08 * height), Material.RIM)))


def make_post(length: float, width: float, height: float) -> Mesh:
    """Return a round post or bollard."""
    return fit_to_size(tube((0, 0, 0), (0, 0, 1), 0.5, Material.METAL, sides=8), length, width, height)


def make_rack(length: float, width: float, height: float) -> Mesh:
    """Return bicycles in a rack across its `length`, without riders, every fifth place empty; for one place a bicycle.

    A single bicycle stands along x.
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
    """Return a parked motorcycle."""
    return fit_to_size(motorcycle(SHAPES["motorcycle"][0], ridden=False), length, width, height)


def make_trailer(length: float, width: float, height: float) -> Mesh:
    """Return a parked car trailer: a tarpaulin on boards, one axle, and a drawbar ahead."""
    bed, rear = 0.72 * length, -length / 2
    middle, floor = rear + bed / 2, min(0.5, 0.4 * height)
    parts = [
        box((middle, 0, floor), (bed, 0.84 * width, 0.1), Material.TRIM),
        box((middle, 0, floor + 0.15 * height), (bed, 0.84 * width, 0.3 * height), Material.METAL),
        box((middle, 0, (floor + height) / 2 + 0.1), (0.96 * bed, 0.8 * width, height - floor - 0.2), Material.CLOTH),
        box(((rear + bed + length / 2) / 2, 0, floor), (length - bed, 0.08, 0.08), Material.METAL),
        add_mirror_image(transform_mesh(wheel(0.29, 0.16), middle, width / 2 - 0.08)),
    ]
    return fit_to_size(join_meshes(parts), length, width, height)


def make_guard_rail(length: float, width: float, height: float) -> Mesh:
    """Return a guard rail: a corrugated beam before posts."""
    waves = ((0.0, 1.0), (0.5, 0.86), (0.0, 0.72), (0.5, 0.58), (0.0, 0.44))
    rows = [[(x, width * (0.5 - depth), height * top) for depth, top in waves] for x in (-length / 2, length / 2)]
    count = max(2, round(length / POST_M))
    posts = [
        box((x, -0.3 * width, 0.4 * height), (0.06, 0.4 * width, 0.8 * height), Material.METAL)
        for x in ((np.arange(count) - (count - 1) / 2) * length / count).tolist()
    ]
    return fit_to_size(join_meshes((sheet(rows, Material.METAL), *posts)), length, width, height)


def _barrier(length: float, width: float, height: float, pitch_m: float, full: float, material: Material) -> Mesh:
    """Return upright slats, `full` of their pitch wide, and two rails at 20 % and 85 % of the height."""
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


def _leafy(
    grid: NDArray[np.float64], size: tuple[float, float, float], rng: np.random.Generator, closed: bool = False
) -> Mesh:
    """Return the surface through a grid (A, B, 3) of unit extents, made uneven, scaled to `size`, with loose leaves.

    With `closed` the last column of the grid continues in the first.
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
