"""Draping over a relief: polygons and lines are cut along the relief's triangles, and then lifted."""

from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flcav.world.map.relief import Relief
from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, sheet

Array = NDArray[np.float64]

FLAT_M = 0.01  # by which a wall may differ from the relief between its corners
GRID_M = 1e-3  # of coordinates, where exact ones defeat GEOS
FEW = 64  # triangles, or corners of an area, that are intersected at once
BESIDE_M = 1.0  # around triangles, of the part of an area with which they are intersected


def drape_polygon(polygon: Array, relief: Relief, above_m: float, material: Material) -> Mesh:
    """Return the part of a relief inside a polygon (K, 2) [m], raised by `above_m`: exact, plane in each triangle."""
    return drape_area(shapely.make_valid(shapely.Polygon(polygon)), relief, above_m, material)


def drape_area(area: BaseGeometry, relief: Relief, above_m: float, material: Material) -> Mesh:
    """Return the part of a relief inside a valid area, which may have holes: see `drape_polygon`."""
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
    """Return what of each of `triangles` (F,) is inside an area.

    An intersection takes time with all corners of the area: for many triangles, it is first halved, and halved again.
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
    """Return an upright wall along a closed ring (K + 1, 2) [m], between two heights above the relief.

    It is exact at the ring's corners, and to `FLAT_M` at the edges of triangles between them.
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


def _find_bends(along: Array, height: Array, corner: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (N,) the corners and those between which `height` is linear to `FLAT_M` (Douglas-Peucker)."""
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
