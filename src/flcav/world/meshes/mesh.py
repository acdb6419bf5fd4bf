"""Triangle meshes, primitives, and draping over a terrain relief. Body frame: x forward, y left, z up [m].

Draping cuts polygons and lines along the relief's triangles, and then lifts the pieces onto it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Array32, Bytes, Ints32, Mask
from flcav.geometry import rotations_about_z
from flcav.world.map.relief import Relief
from flcav.world.materials import Material

BOWED_M = 0.6  # length of the front and rear of a vehicle that curve in plan
_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]], np.int32)
_BOX_FACES = _BOX_QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with one material per face."""

    vertices: Array32  # (V, 3) [m]
    faces: Ints32  # (F, 3) vertex indices
    material: Bytes  # (F,) `Material` of each face

    def normals(self) -> Array32:
        """Return the unit normals of the faces (F, 3), of either sign; zero where a face has no area."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return (normal / np.maximum(length, 1e-12)).astype(np.float32)

    def corner_normals(self, crease_deg: float = 40.0) -> Array32:
        """Return the area-weighted unit normals at each face's corners (F, 3, 3), for smooth shading.

        The normal at a corner averages the faces that share it and differ from this face by less than `crease_deg`.
        Signs are those of `normals`.
        """
        corners = self.vertices[self.faces]
        flat = self.normals().astype(np.float64)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        _, place = np.unique(corners.reshape(-1, 3).round(4), axis=0, return_inverse=True)
        # Corners at the same place, to 0.1 mm, are consecutive in `order`; there are few per place, so that all pairs
        # of their faces are compared.
        order = np.argsort(place, kind="stable")
        starts = np.searchsorted(place[order], np.arange(place.max() + 2))
        out = np.empty((len(order), 3))
        for first, last in pairwise(starts):
            shared = order[first:last]
            normal = flat[shared // 3]
            weight = area[shared // 3]
            alike = normal @ normal.T
            share = np.where(np.abs(alike) > np.cos(np.radians(crease_deg)), np.sign(alike) * weight, 0.0)
            out[shared] = share @ normal
        out = out.reshape(-1, 3, 3)
        length = np.linalg.norm(out, axis=2, keepdims=True)
        return np.where(length > 1e-12, out / np.maximum(length, 1e-12), flat[:, None]).astype(np.float32)

    def bounds(self) -> tuple[Array, Array]:
        """Return the axis-aligned bounding box: the lowest and the highest x, y, z, (3,) and (3,) [m]."""
        return self.vertices.min(axis=0).astype(np.float64), self.vertices.max(axis=0).astype(np.float64)


def join_meshes(parts: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes into one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]).astype(np.float32),
        np.concatenate([part.faces + start for part, start in zip(parts, starts)]).astype(np.int32),
        np.concatenate([part.material for part in parts]),
    )


def transform_mesh(mesh: Mesh, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """Return `mesh` rotated by `yaw` [rad] about z and then translated by x, y, z [m]."""
    turn = np.ascontiguousarray(rotations_about_z(yaw).T)
    return Mesh((mesh.vertices @ turn + (x, y, z)).astype(np.float32), mesh.faces, mesh.material)


def add_mirror_image(mesh: Mesh) -> Mesh:
    """Return `mesh` together with its mirror image in the x-z plane, as one mesh."""
    other = Mesh(mesh.vertices * np.array([1, -1, 1], np.float32), mesh.faces[:, ::-1], mesh.material)
    return join_meshes((mesh, other))


def fit_to_size(mesh: Mesh, length: float, width: float, height: float) -> Mesh:
    """Return `mesh` scaled to exactly these outer dimensions [m], standing on z = 0, centred on the origin."""
    low, high = mesh.bounds()
    unit = (mesh.vertices - low) / (high - low)
    vertices = (unit - (0.5, 0.5, 0.0)) * (length, width, height)
    return Mesh(vertices.astype(np.float32), mesh.faces, mesh.material)


def bow_ends(mesh: Mesh, bow_m: float) -> Mesh:
    """Return a vehicle's mesh with front and rear curved in plan: their corners lie `bow_m` [m] behind their middles.

    The last `BOWED_M` of either end recede with the cube of the lateral distance from the middle, as bumpers do.
    """
    x, y, _ = mesh.vertices.T
    end, side = float(x.max()), float(y.max())
    near = np.clip((np.abs(x) - (end - BOWED_M)) / BOWED_M, 0, 1)
    vertices = mesh.vertices.copy()
    vertices[:, 0] -= np.sign(x) * near * bow_m * np.abs(y / side) ** 3
    return Mesh(vertices, mesh.faces, mesh.material)


def sheet(points: ArrayLike, material: Material | Bytes) -> Mesh:
    """Return the mesh of the surface through a grid of points (A, B, 3) [m], two triangles per cell.

    `material` is one for all cells, or an array (A - 1, B - 1).
    """
    grid = np.asarray(points, np.float64)
    rows, columns = grid.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.stack((a, b, c, a, c, d), axis=1).reshape(-1, 3)
    cells = np.broadcast_to(np.asarray(material, np.uint8), (rows - 1, columns - 1))
    return Mesh(grid.reshape(-1, 3).astype(np.float32), faces.astype(np.int32), np.repeat(cells.ravel(), 2))


def box(center: ArrayLike, size: ArrayLike, material: Material) -> Mesh:
    """Return a closed box about `center` (3,) with extents `size` (3,) along x, y, z [m]."""
    vertices = _BOX_CORNERS * np.asarray(size) + np.asarray(center)
    return Mesh(vertices.astype(np.float32), _BOX_FACES, np.full(12, material, np.uint8))


def tube(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    material: Material,
    *,
    end_radius: float | None = None,
    sides: int = 8,
    capped: bool = True,
) -> Mesh:
    """Return the mesh of a cylinder or truncated cone from `start` (3,) to `end` (3,) [m], with `sides` faces.

    The radius goes from `radius` to `end_radius` [m], by default the same; `capped` closes the ends.
    """
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    along = (last - first) / np.linalg.norm(last - first)
    aside = np.cross(along, (1.0, 0.0, 0.0) if abs(along[2]) > 0.9 else (0.0, 0.0, 1.0))
    aside /= np.linalg.norm(aside)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    circle = np.cos(angle) * aside + np.sin(angle) * np.cross(along, aside)
    rings = [first + circle * radius, last + circle * (radius if end_radius is None else end_radius)]
    if capped:
        rings = [first + circle * 0, *rings, last + circle * 0]
    return sheet(np.stack(rings), material)


def ellipsoid(center: ArrayLike, radii: ArrayLike, material: Material, sides: int = 8) -> Mesh:
    """Return an ellipsoid about `center` (3,) with half axes `radii` (3,) [m], of `sides` meridians."""
    polar = np.linspace(0, np.pi, sides // 2 + 2)[:, None]
    around = np.linspace(0, 2 * np.pi, sides + 1)[None]
    unit = np.stack(
        (np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around), axis=-1
    )
    return sheet(unit * np.asarray(radii) + np.asarray(center), material)


FLAT_M = 0.01  # largest difference of a wall's foot from the relief between its corners
GRID_M = 1e-3  # precision grid of coordinates where GEOS fails with exact ones
FEW = 64  # triangles, or corners of an area, up to which they are intersected at once
BESIDE_M = 1.0  # margin around triangles of the part of an area that is intersected with them


def drape_polygon(polygon: Array, relief: Relief, above_m: float, material: Material) -> Mesh:
    """Return the mesh of the relief inside a polygon (K, 2) [m], world frame, raised by `above_m`; it is exact."""
    return drape_area(shapely.make_valid(shapely.Polygon(polygon)), relief, above_m, material)


def drape_area(area: BaseGeometry, relief: Relief, above_m: float, material: Material) -> Mesh:
    """Return the mesh of the relief inside a valid area [m], which may have holes: see `drape_polygon`."""
    shapely.prepare(area)
    near = relief.tree.geometries[relief.tree.query(area, predicate="intersects")]
    parts = shapely.get_parts(_cut(near, area))
    parts = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > 0)]
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(parts))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.c_[corners, relief.heights(*corners.T) + above_m].astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def _cut(triangles: NDArray[np.object_], area: BaseGeometry) -> NDArray[np.object_]:
    """Return the intersections (F,) of `triangles` (F,) with an area.

    The cost of an intersection grows with the corners of the whole area, so for many triangles the area is bisected
    recursively.
    """
    if len(triangles) <= FEW or shapely.get_num_coordinates(area) <= FEW:
        try:
            return shapely.intersection(triangles, area)
        except shapely.GEOSException:
            return shapely.intersection(triangles, area, grid_size=GRID_M)
    bounds = shapely.bounds(triangles)
    middle = bounds[:, :2] + bounds[:, 2:]
    rank = np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")
    out = np.empty(len(triangles), object)
    for half in np.array_split(rank, 2):
        low, high = bounds[half, :2].min(axis=0) - BESIDE_M, bounds[half, 2:].max(axis=0) + BESIDE_M
        out[half] = _cut(triangles[half], shapely.intersection(area, shapely.box(*low, *high)))
    return out


def drape_wall(ring: Array, relief: Relief, between_m: tuple[float, float], material: Material) -> Mesh:
    """Return the mesh of an upright wall along a closed ring (K + 1, 2) [m], between two heights above the relief [m].

    It is exact at the ring's corners, and within `FLAT_M` at the triangle edges between them.
    """
    line = shapely.LineString(ring)
    near = relief.tree.geometries[relief.tree.query(line, predicate="intersects")]
    cuts = shapely.get_coordinates(shapely.intersection(shapely.boundary(near), line))
    corners = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(ring, axis=0).T))))
    along = np.unique(np.concatenate((corners, shapely.line_locate_point(line, shapely.points(cuts)))))
    points = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    ground = relief.heights(*points.T)
    kept = np.flatnonzero(_find_bends(along, ground, np.isin(along, corners)))
    points, ground = points[kept], ground[kept]
    return sheet(np.stack([np.c_[points, ground + above] for above in between_m]), material)


def _find_bends(along: Array, height: Array, corner: Mask) -> Mask:
    """Return (N,) the corners, and the points needed so that `height` is linear within `FLAT_M` (Douglas-Peucker)."""
    kept, waiting = corner.copy(), list(pairwise(np.flatnonzero(corner).tolist()))
    while waiting:
        first, last = waiting.pop()
        chord = np.interp(along[first : last + 1], along[[first, last]], height[[first, last]])
        error = np.abs(height[first : last + 1] - chord)
        worst = first + int(error.argmax())
        if error.max() > FLAT_M:
            kept[worst] = True
            waiting += [(first, worst), (worst, last)]
    return kept
