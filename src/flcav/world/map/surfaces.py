"""Ground surfaces of a town as polygons: roads, sidewalks and traffic islands, and the kerbs between them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.errors import GEOSException
from shapely.geometry import LineString, MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge, split

from flcav.arrays import Array
from flcav.geometry import heading_vectors
from flcav.world.map.roads import CARRIAGEWAY, RoadNet

GRID_M = 1e-3  # precision grid of coordinates where GEOS fails with exact ones
SLIVER_M = 0.25  # narrower pieces are dropped, narrower gaps closed, shorter lanes left out: artefacts of the net

ISLAND_M = 25.0  # greatest distance of a traffic island's interior from the road; wider land is open ground


@dataclass(frozen=True)
class GroundSurfaces:
    """The ground surfaces of a town, as shapely geometry in the world frame [m]."""

    roads: MultiPolygon  # carriageways and junctions
    sidewalks: MultiPolygon  # with the paving behind them and the traffic islands
    islands: MultiPolygon  # traffic islands: narrow holes of the roads without a sidewalk in them


def build_ground_surfaces(
    net: RoadNet, frontage_m: Mapping[str, float], parking: Sequence[Polygon] = ()
) -> GroundSurfaces:
    """Build the ground surfaces of a net; `frontage_m` is the width of paving behind the sidewalk [m], by street type.

    Spaces for `parking`, world frame [m], are part of the road.
    """
    driven = [*parking] + [
        LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
        for edge in net.edges.values()
        for lane in edge.lanes
        if lane.kind in CARRIAGEWAY and LineString(lane.shape).length > SLIVER_M
    ]
    walked, paved = [], []
    narrowest = min(frontage_m.values(), default=0.0)
    for edge in net.edges.values():
        for lane in edge.lanes:
            if lane.kind == "sidewalk" and len(lane.shape) > 1:
                area = LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
                frontage = frontage_m.get(edge.type, narrowest)
            elif lane.kind == "walkingarea" and len(lane.shape) > 2:
                area, frontage = shapely.make_valid(Polygon(lane.shape)), narrowest
            else:
                continue
            walked.append(area)
            paved.append(area.buffer(frontage, join_style="mitre"))
    inside = [Polygon(junction.shape).buffer(0) for junction in net.junctions.values() if len(junction.shape) > 2]
    driven_area, walked_area = unite(driven), unite(walked)
    roads = join_areas(driven_area, cut_area(unite(inside), walked_area))
    roads = MultiPolygon([part for part in _clean(roads).geoms if part.intersects(driven_area)])
    sidewalks = cut_area(unite(paved), roads)
    islands = MultiPolygon(
        [
            hole
            for hole in (Polygon(ring) for part in roads.geoms for ring in part.interiors)
            if not hole.intersects(walked_area.buffer(-SLIVER_M)) and hole.buffer(-ISLAND_M).is_empty
        ]
    )
    return GroundSurfaces(roads, _clean(join_areas(sidewalks, islands)), islands)


def unite(areas: Sequence[BaseGeometry]) -> BaseGeometry:
    """Return the union of areas [m]; on a grid of `GRID_M` where GEOS fails with exact coordinates."""
    try:
        return shapely.union_all(areas)
    except GEOSException:
        return shapely.union_all([_snap(area) for area in areas], grid_size=GRID_M)


def join_areas(area: BaseGeometry, other: BaseGeometry) -> BaseGeometry:
    """Return the union of two areas [m], as `unite` does."""
    try:
        return shapely.union(area, other)
    except GEOSException:
        return shapely.union(_snap(area), _snap(other), grid_size=GRID_M)


def cut_area(area: BaseGeometry, other: BaseGeometry) -> BaseGeometry:
    """Return the difference of two areas [m]; on a grid of `GRID_M` where GEOS fails with exact coordinates."""
    try:
        return shapely.difference(area, other)
    except GEOSException:
        return shapely.difference(_snap(area), _snap(other), grid_size=GRID_M)


def _snap(area: BaseGeometry) -> BaseGeometry:
    """Return a valid area with its vertices on the grid."""
    return shapely.set_precision(shapely.make_valid(area), GRID_M)


def split_into_polygons(area: BaseGeometry) -> tuple[Array, ...]:
    """Split an area [m] into polygons (K, 2) without holes, counter-clockwise, first vertex not repeated."""
    pieces: list[Array] = []
    for part in _polygons(area):
        if part.interiors:
            x = Polygon(part.interiors[0]).representative_point().x
            _, low, _, high = part.bounds
            cut = LineString([(x, low - 1), (x, high + 1)])
            pieces.extend(split_into_polygons(split(part, cut)))
        else:
            pieces.append(np.asarray(shapely.geometry.polygon.orient(part).exterior.coords)[:-1])
    return tuple(pieces)


def find_kerbs(ground: GroundSurfaces) -> tuple[Array, ...]:
    """Return the kerbs: polylines (K, 2) along which road meets sidewalk, world frame [m]."""
    shared = ground.roads.boundary.intersection(ground.sidewalks.buffer(0.02))
    lines = [line for line in getattr(shared, "geoms", [shared]) if isinstance(line, LineString) and line.length > 0]
    merged = linemerge(lines)
    return tuple(np.asarray(line.coords) for line in getattr(merged, "geoms", [merged]) if line.length > 0.5)


def _clean(area: BaseGeometry) -> MultiPolygon:
    """Return the area after opening and closing by `SLIVER_M`, simplified, without parts below 1 m²."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a mitre divides by the sine of its angle, even by 0
        opened = area.buffer(-SLIVER_M / 2, join_style="mitre").buffer(SLIVER_M, join_style="mitre")
        closed = opened.buffer(-SLIVER_M / 2, join_style="mitre").simplify(0.02)
    return MultiPolygon([part for part in _polygons(closed) if part.area > 1.0])


def _polygons(area: BaseGeometry) -> Iterable[Polygon]:
    parts = getattr(area, "geoms", [area])
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]


def make_footprint(x: float, y: float, yaw: float, length: float, width: float) -> Polygon:
    """Return the rectangle with centre x, y [m], heading `yaw` [rad] and these extents [m] as a polygon."""
    rectangle = box(-length / 2, -width / 2, length / 2, width / 2)
    cos, sin = heading_vectors(yaw).tolist()
    return shapely.affinity.affine_transform(rectangle, [cos, -sin, sin, cos, x, y])
