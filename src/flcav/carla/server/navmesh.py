"""The navigation mesh of a town, which CARLA's clients fetch for their walkers: footpaths and crossings as triangles.

The client's own crowd (Recast and Detour) walks on it. The file is a mesh set of one tile, version 7 of Detour's data,
without a tree over its polygons. Its frame is CARLA's with y and z exchanged; seen from above polygons turn clockwise
in that frame (`DetourNavMesh.h`, `DetourNavMeshBuilder.cpp`; areas and flags are those of `carla/nav/Navigation.h`).
"""

import struct
from enum import IntEnum

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.carla.frames import MapFrame
from flcav.world.map.roads import RoadNet
from flcav.world.map.town import KERB_M, Town

GRID_M = 0.01  # of corners
JOINED_M = 0.15  # paths so near to each other are one
SMOOTHED_M = 0.08  # most that outlines move
SMALLEST_M2 = 0.5  # of a face that is walked on
MOST_CORNERS = 0xFFFE  # that the format can number
SET = struct.Struct("<3i3f2f2iIi")  # "MSET", version, tiles; origin, size and capacities of the mesh; reference, bytes
TILE = struct.Struct("<5iI9i10f")  # "DNAV", version, place; user; counts; walkers; bounds; factor of a tree
POLYGON = np.dtype(
    [
        ("link", "<u4"),
        ("corners", "<u2", 6),
        ("neighbours", "<u2", 6),
        ("flags", "<u2"),
        ("count", "u1"),
        ("area", "u1"),
    ]
)
DETAIL = np.dtype([("corner", "<u4"), ("first", "<u4"), ("corners", "u1"), ("triangles", "u1"), ("", "<u2")])
LINK_BYTES = 12
OUTLINE = 0b010101  # all edges of a triangle are edges of its polygon
WALKER_M = (2.0, 0.3, 0.4)  # height, radius and climb


class Area(IntEnum):
    """Kinds of ground for walkers; the flag of a kind is 1 << kind."""

    SIDEWALK = 1
    CROSSING = 2


def build_navigation_mesh(net: RoadNet, town: Town, frame: MapFrame) -> bytes:
    """Return the file of a town's navigation mesh; empty without footpaths, and beyond `MOST_CORNERS`."""
    corners, triangles, areas = triangulate(*list_footpaths(net))
    if not len(triangles) or len(corners) > MOST_CORNERS:
        return b""
    height = town.grounds(*corners.T) + KERB_M
    points = frame.to_location(np.column_stack((corners, height)))
    return pack_mesh(points, triangles, areas)


def list_footpaths(net: RoadNet) -> tuple[BaseGeometry, BaseGeometry]:
    """Return what of a net are footpaths, and what are crossings between them [m]."""
    paths, crossings = list[BaseGeometry](), list[BaseGeometry]()
    for lane in (lane for edge in net.edges.values() for lane in edge.lanes):
        if lane.kind == "walkingarea" and len(lane.shape) > 2:
            paths.append(Polygon(lane.shape).buffer(0))
        elif lane.kind == "sidewalk":
            paths.append(LineString(lane.shape).buffer(lane.width / 2, cap_style="flat"))
        elif lane.kind == "crossing":
            crossings.append(LineString(lane.shape).buffer(lane.width / 2, cap_style="square"))
    walked = shapely.union_all(paths).buffer(JOINED_M).buffer(-JOINED_M).simplify(SMOOTHED_M)
    walked = shapely.set_precision(walked, GRID_M)
    return walked, shapely.difference(shapely.union_all(crossings), walked, grid_size=GRID_M)


def triangulate(walked: BaseGeometry, crossed: BaseGeometry) -> tuple[NDArray, NDArray, NDArray]:
    """Return corners (V, 2) [m], counter-clockwise triangles (T, 3) that share whole edges, and their areas (T,)."""
    lines = shapely.union_all([walked.boundary, crossed.boundary], grid_size=GRID_M)
    faces = shapely.polygonize(shapely.get_parts(lines))
    rings, areas = list[NDArray](), list[int]()
    for face in shapely.get_parts(faces):
        inside = face.representative_point()
        area = Area.SIDEWALK if walked.contains(inside) else Area.CROSSING if crossed.contains(inside) else None
        if area is None or face.area < SMALLEST_M2:
            continue
        for part in shapely.get_parts(shapely.constrained_delaunay_triangles(face)):
            rings.append(shapely.get_coordinates(shapely.orient_polygons(part))[:3])
            areas.append(area)
    if not rings:
        return np.zeros((0, 2)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners, index = np.unique(np.concatenate(rings).round(3), axis=0, return_inverse=True)
    return corners, index.reshape(-1, 3), np.array(areas)


def find_neighbours(triangles: NDArray) -> NDArray:
    """Return for each edge (T, 3) of triangles, from a corner to the next, 1 + the triangle beyond it; 0 for none."""
    start, end = triangles, np.roll(triangles, -1, axis=1)
    rows = {edge: row for row, edge in enumerate(zip(start.ravel().tolist(), end.ravel().tolist(), strict=True))}
    beyond = [rows.get((b, a), -3) // 3 + 1 for a, b in zip(start.ravel().tolist(), end.ravel().tolist(), strict=True)]
    return np.array(beyond).reshape(-1, 3)


def pack_mesh(points: NDArray, triangles: NDArray, areas: NDArray) -> bytes:
    """Return the file of a mesh: points (V, 3) in CARLA's frame [m], triangles (T, 3) clockwise there by x and y."""
    places = points[:, (0, 2, 1)].astype("<f4")
    low, high = places.min(axis=0), places.max(axis=0)
    count, bits = len(triangles), max(int(len(triangles) - 1).bit_length(), 1)
    polygons = np.zeros(count, POLYGON)
    polygons["corners"][:, :3] = triangles
    polygons["neighbours"][:, :3] = find_neighbours(triangles)
    polygons["flags"], polygons["count"], polygons["area"] = 1 << areas, 3, areas
    details = np.zeros(count, DETAIL)
    details["first"], details["triangles"] = np.arange(count), 1
    faces = np.tile(np.array((0, 1, 2, OUTLINE), np.uint8), (count, 1))
    links = 3 * count
    head = TILE.pack(
        *(int.from_bytes(b"DNAV", "big"), 7, 0, 0, 0, 0),
        *(count, len(places), links, count, 0, count, 0, 0, count),
        *(*WALKER_M, *low.tolist(), *high.tolist(), 1.0),
    )
    body = (places, polygons, np.zeros(links * LINK_BYTES, np.uint8), details, faces)
    tile = head + b"".join(part.tobytes() for part in body)
    size = (high - low)[[0, 2]].tolist()
    told = (int.from_bytes(b"MSET", "big"), 1, 1)
    return SET.pack(*told, *low.tolist(), *size, 1, 1 << bits, 1 << bits, len(tile)) + tile
