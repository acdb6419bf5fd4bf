"""Draping over a relief: polygons are cut along the relief's triangles, lines at short intervals, and then lifted."""

import numpy as np
import shapely
from numpy.typing import NDArray

from flcav.world.map.relief import Relief
from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, sheet

Array = NDArray[np.float64]

SPACING_M = 1.0  # between the points at which a line is lifted
GRID_M = 1e-3  # of coordinates, where exact ones defeat GEOS


def drape_polygon(polygon: Array, relief: Relief, above_m: float, material: Material) -> Mesh:
    """Return the part of a relief inside a polygon (K, 2) [m], raised by `above_m`: exact, plane in each triangle."""
    area = shapely.make_valid(shapely.Polygon(polygon))
    shapely.prepare(area)
    near = relief.tree.geometries[relief.tree.query(area, predicate="intersects")]
    try:
        pieces = shapely.intersection(near, area)
    except shapely.GEOSException:
        pieces = shapely.intersection(near, area, grid_size=GRID_M)
    parts = shapely.get_parts(pieces)
    parts = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > 0)]
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(parts))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.c_[corners, relief.heights(*corners.T) + above_m].astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def drape_wall(ring: Array, relief: Relief, between_m: tuple[float, float], material: Material) -> Mesh:
    """Return an upright wall along a closed ring (K + 1, 2) [m], between two heights above the relief."""
    line = shapely.get_coordinates(shapely.segmentize(shapely.LineString(ring), SPACING_M))
    ground = relief.heights(*line.T)
    return sheet(np.stack([np.c_[line, ground + above] for above in between_m]), material)
