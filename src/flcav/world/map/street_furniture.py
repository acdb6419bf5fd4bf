"""Procedural placement along the streets of a town: buildings, trees, clutter, fences, lamps, signs, candidate poles.

Positions and yaws are in the world frame [m, rad]. The same random generator gives the same placement. Boundaries of
plots (hedges, walls, fences) and small objects at the kerb are clutter, too: rows (K, 6) x, y, yaw, length, width,
height by kind, world frame [m, rad]. Parking spaces and roadside objects of an imported map replace random ones.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array
from flcav.geometry import heading_vectors
from flcav.world.map.layers import Marking
from flcav.world.map.parameters import (
    CLUTTER,
    Interval,
    ObjectParameters,
    ParkingParameters,
    PoleParameters,
    SignParameters,
    StreetParameters,
    TownParameters,
)
from flcav.world.map.roads import Edge, RoadNet
from flcav.world.map.surfaces import GroundSurfaces, make_footprint

CORNER_M = 9.0  # distance by which a row of buildings may extend beyond its edge's ends
STEP_M = 1.0  # shift along the street to the next attempt if an object does not fit
CELL_M = 20.0  # side of the cells by which built land is indexed
CLEARANCE_M = 0.25  # least distance between solid objects
SENSOR_CLEAR_M = 2.5  # least distance of a street lamp from a roadside sensor, since it would block the view
KERBSIDE_M = 0.4  # distance of the centres of kerbside objects from the kerb
SIGN_HEIGHT_M = 2.2  # height of a plate's centre
SPEED_SIGNS: dict[int, Literal["speed_30", "speed_60", "speed_90"]] = {  # limit [km/h] -> kind of sign
    30: "speed_30",
    60: "speed_60",
    90: "speed_90",
}


class Plot:
    """The occupancy of a town's land: the area closed to building, and the footprints of placed objects."""

    def __init__(self, closed: BaseGeometry) -> None:
        """Start without objects; `closed` is the area that stays free, world frame [m]."""
        self._closed = closed
        shapely.prepare(self._closed)
        self._taken: dict[tuple[int, int], list[Polygon]] = {}  # by the cells that a footprint touches

    def build(self, shape: Polygon, apart_m: float = CLEARANCE_M) -> bool:
        """Reserve the footprint `shape`, world frame [m], and return True; return False if it is not free.

        It is free if it does not touch the closed area and is farther than `apart_m` [m] from all reserved footprints.
        """
        if self._closed.intersects(shape):
            return False
        near = [other for cell in _list_cells(shape, apart_m) for other in self._taken.get(cell, ())]
        if near and shapely.dwithin(np.array(near), shape, apart_m).any():
            return False
        for cell in _list_cells(shape, 0.0):
            self._taken.setdefault(cell, []).append(shape)
        return True


def _list_cells(shape: Polygon, around_m: float) -> list[tuple[int, int]]:
    """Return the cells that the bounds of a shape, widened by `around_m` [m], touch."""
    low_x, low_y, high_x, high_y = shape.bounds
    columns, rows = (
        range(int((low - around_m) // CELL_M), int((high + around_m) // CELL_M) + 1)
        for low, high in ((low_x, high_x), (low_y, high_y))
    )
    return [(column, row) for column in columns for row in rows]


@dataclass(frozen=True)
class Verge:
    """The centre line of an outer lane, mostly a sidewalk, in driving direction.

    Its right, or with left-hand traffic its left, is away from the road.
    """

    line: LineString  # world frame [m]
    half_width: float  # of the lane [m]
    street: StreetParameters
    side: int = 1  # side of the traffic: 1 right, -1 left

    def at(self, along_m: float, right_m: float) -> tuple[float, float, float]:
        """Return x, y [m] and the driving direction [rad] at `along_m` [m] on the line, shifted `right_m` [m] outwards.

        Outwards is to the right, with left-hand traffic to the left. The line is extended straight beyond its ends.
        """
        inside = float(np.clip(along_m, 0.0, self.line.length))
        before, after = max(inside - 0.5, 0.0), min(inside + 0.5, self.line.length)
        a, b = self.line.interpolate(before), self.line.interpolate(after)
        yaw = float(np.arctan2(b.y - a.y, b.x - a.x))
        here = self.line.interpolate(inside)
        on = along_m - inside
        cos, sin = heading_vectors(yaw)
        x = here.x + on * cos + self.side * right_m * sin
        y = here.y + on * sin - self.side * right_m * cos
        return float(x), float(y), yaw


def list_verges(net: RoadNet, parameters: TownParameters) -> Iterator[Verge]:
    """Yield the verges of the sidewalks of all streets, in the net's order."""
    for edge in net.streets:
        for lane in edge.lanes_of("sidewalk"):
            yield Verge(LineString(lane.shape), lane.width / 2, parameters.streets[edge.type], net.side)


def place_buildings(rows: list[Verge], plot: Plot, random: np.random.Generator) -> Array:
    """Place rows of buildings along the verges with random gaps: (B, 6) x, y, yaw, length, width, height [m, rad]."""
    out = []
    for verge in rows:
        street = verge.street
        along = -CORNER_M
        while along < verge.line.length + CORNER_M:
            length, width = (
                draw_uniform(random, street.building_length_m),
                draw_uniform(random, street.building_depth_m),
            )
            height = draw_uniform(random, street.building_height_m)
            right = verge.half_width + street.frontage_m + draw_uniform(random, street.setback_m) + width / 2
            for candidate in (length, street.building_length_m[0]):
                x, y, yaw = verge.at(along + candidate / 2, right)
                if plot.build(make_footprint(x, y, yaw, candidate, width)):
                    out.append((x, y, yaw, candidate, width, height))
                    along += candidate + max(CLEARANCE_M, draw_uniform(random, street.building_gap_m))
                    break
            else:
                along += STEP_M
    return _rows(out, 6)


def place_clutter(rows: list[Verge], plot: Plot, random: np.random.Generator) -> tuple[tuple[str, Array], ...]:
    """Place clutter just behind the sidewalks, by kind: rows (K, 6) x, y, yaw, length, width, height [m, rad]."""
    pieces: list[Piece] = []
    for verge in rows:
        for along in list_stations(verge, verge.street.clutter_spacing_m, random):
            kind = _choose(verge.street.clutter, random)
            length, width, height = np.array(CLUTTER[kind]) * random.uniform(*verge.street.clutter_size, size=3)
            x, y, yaw = verge.at(along, verge.half_width + 0.15 + width / 2)
            if plot.build(make_footprint(x, y, yaw, length, width)):
                pieces.append((kind, (x, y, yaw, length, width, height)))
    return _by_kind(pieces)


def place_trees(rows: list[Verge], ground: GroundSurfaces, plot: Plot, random: np.random.Generator) -> Array:
    """Place trees along the streets and on the traffic islands: (T, 4) x, y, height, crown radius [m]."""
    out = []

    def plant(x: float, y: float, room: Callable[[Polygon], bool]) -> None:
        height = float(random.uniform(4.5, 9.0))
        if room(Point(x, y).buffer(0.45)):
            out.append((x, y, height, float(height * random.uniform(0.22, 0.32))))

    for verge in rows:
        for along in list_stations(verge, verge.street.tree_spacing_m, random):
            x, y, _ = verge.at(along, verge.half_width + random.uniform(0.6, 2.4))
            if verge.street.trees_at_kerb and random.random() < verge.street.trees_at_kerb:
                x, y, _ = verge.at(along, KERBSIDE_M - verge.half_width)
                plant(x, y, lambda _: True)
                continue
            plant(x, y, plot.build)
    for island in ground.islands.geoms:
        inner = island.buffer(-1.5)
        low_x, low_y, high_x, high_y = island.bounds
        for _ in range(int(island.area / 45.0)):
            x, y = float(random.uniform(low_x, high_x)), float(random.uniform(low_y, high_y))
            plant(x, y, inner.contains)
    return _rows(out, 4)


def place_lamps(rows: list[Verge], sensors: Array, random: np.random.Generator) -> Array:
    """Place the street lamps at the kerb: (L, 3) x, y of the foot and height [m].

    A lamp within `SENSOR_CLEAR_M` of one of the roadside `sensors` (P, 3) [m] is shifted along the street.
    """
    out = []
    for verge in rows:
        for along in list_stations(verge, verge.street.lamp_spacing_m, random):
            x, y, _ = verge.at(along, 0.3 - verge.half_width)
            while len(sensors) and np.hypot(*(sensors[:, :2] - (x, y)).T).min() < SENSOR_CLEAR_M:
                along += STEP_M
                x, y, _ = verge.at(along, 0.3 - verge.half_width)
            out.append((x, y, 7.0))
    return _rows(out, 3)


def place_poles(
    net: RoadNet, parameters: tuple[PoleParameters, ...]
) -> list[tuple[int, tuple[float, float, float], float, str]]:
    """Place the candidate sites: return id, position [m], yaw [rad] and kind, in the order of the ids.

    A straight site faces across the road, another one its junction or the centre of its roundabout. Raises `KeyError`
    for an edge that the net lacks.
    """
    out = []
    for pole in sorted(parameters, key=lambda pole: pole.id):
        x, y, heading = _kerb_side(net.edges[pole.edge], pole.before_end_m, net.side)
        yaw = heading + net.side * np.pi / 2
        if pole.kind != "straight":
            target = net.junctions[net.edges[pole.edge].end].centre
            if net.edges[pole.edge].end in net.roundabouts:
                circle = [net.junctions[name].centre for name in sorted(net.roundabouts)]
                target = np.mean(circle, axis=0)
            yaw = np.arctan2(target[1] - y, target[0] - x)
        out.append((pole.id, (x, y, pole.height_m), float(yaw), pole.kind))
    return out


def place_signs(
    net: RoadNet, known: tuple[SignParameters, ...] = (), *, limits_known: bool = False
) -> list[tuple[tuple[float, float, float], float, str]]:
    """Place the signs: return position [m], yaw [rad] and kind; yield and stop before junctions, the limit after them.

    `known` signs of right of way, or of speed limits, replace all signs of the same sort. With `limits_known` there are
    no other speed limits even if none is known.
    """
    out = [((sign.x, sign.y, sign.height_m), float(np.radians(sign.yaw_deg)), str(sign.kind)) for sign in known]
    sorts = {kind.partition("_")[0] == "speed" for _, _, kind in out}
    for edge in net.streets:
        if not edge.lanes_of("sidewalk") or not edge.lanes_of("driving"):
            continue
        length = LineString(edge.lanes_of("sidewalk")[-1].shape).length
        states = set(net.right_of_way.get(edge.id, ""))
        kind = "stop" if "s" in states else "yield" if states == {"m"} else None
        wanted = [(kind, 1.5)] if kind else []
        if length > 45.0:
            limit = 3.6 * edge.lanes_of("driving")[0].speed
            wanted.append((SPEED_SIGNS[min(SPEED_SIGNS, key=lambda shown: abs(shown - limit))], length - 12.0))
        for name, before_end in wanted:
            speed = name.startswith("speed")
            if speed in sorts or (speed and limits_known):
                continue
            x, y, heading = _kerb_side(edge, before_end, net.side)
            out.append(((x, y, SIGN_HEIGHT_M), float(heading + np.pi), name))
    return out


def _kerb_side(edge: Edge, before_end_m: float, side: int) -> tuple[float, float, float]:
    """Return x, y [m] of a point on the sidewalk 0.35 m from the kerb, and the driving direction [rad] there."""
    lane = edge.lanes_of("sidewalk")[-1]
    verge = Verge(LineString(lane.shape), lane.width / 2, StreetParameters(), side)
    return verge.at(verge.line.length - before_end_m, 0.35 - verge.half_width)


def list_stations(verge: Verge, spacing_m: float, random: np.random.Generator) -> Iterator[float]:
    """Yield positions along a verge [m] at a spacing of `spacing_m` with a jitter of up to 30 %."""
    along = spacing_m * random.uniform(0.2, 0.8)
    while along < verge.line.length - 2.0:
        yield float(along)
        along += spacing_m * random.uniform(0.7, 1.3)


def draw_uniform(random: np.random.Generator, interval: Interval) -> float:
    """Draw a number uniformly from an interval."""
    return float(random.uniform(*interval))


def _rows(rows: list[tuple[float, ...]], columns: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


Clutter = tuple[tuple[str, Array], ...]  # rows (K, 6) by kind
Piece = tuple[str, tuple[float, ...]]  # kind and row

PIECE_M = 4.0  # longest straight piece of a boundary
JOINT_M = 0.02  # gap between two pieces of a stretch


def place_boundaries(rows: list[Verge], plot: Plot, random: np.random.Generator) -> Clutter:
    """Place hedges, walls and fences along the verges of streets that have them.

    A stretch has one kind, height and setback, and consists of straight pieces; pieces without room are left out.
    """
    pieces: list[Piece] = []
    for verge in rows:
        street = verge.street
        along = draw_uniform(random, street.boundary_gap_m) if street.boundary else np.inf
        while along < verge.line.length:
            end = min(along + draw_uniform(random, street.boundary_length_m), verge.line.length)
            pieces += _stretch(verge, along, end, plot, random)
            along = end + max(draw_uniform(random, street.boundary_gap_m), 0.1)
    return _by_kind(pieces)


def _stretch(verge: Verge, start: float, end: float, plot: Plot, random: np.random.Generator) -> Iterator[Piece]:
    """Yield the pieces of a boundary's stretch from `start` to `end` along the verge [m]."""
    kind = _choose(verge.street.boundary, random)
    _, width, height = np.array(CLUTTER[kind]) * random.uniform(*verge.street.clutter_size, size=3)
    setback = draw_uniform(random, verge.street.boundary_setback_m)
    edges = np.linspace(start, end, max(1, int(np.ceil((end - start) / PIECE_M))) + 1)
    for first, last in pairwise(edges.tolist()):
        x, y, yaw = verge.at((first + last) / 2, verge.half_width + setback + width / 2)
        if plot.build(make_footprint(x, y, yaw, last - first - JOINT_M, width), apart_m=0.0):
            yield kind, (x, y, yaw, last - first - JOINT_M, width, height * random.uniform(0.95, 1.05))


def place_kerbside(rows: list[Verge], random: np.random.Generator) -> Clutter:
    """Place small objects at the kerb of the streets that have them."""
    pieces: list[Piece] = []
    for verge in (verge for verge in rows if verge.street.kerbside):
        for along in list_stations(verge, verge.street.kerbside_spacing_m, random):
            kind = _choose(verge.street.kerbside, random)
            length, width, height = np.array(CLUTTER[kind]) * random.uniform(*verge.street.clutter_size, size=3)
            x, y, yaw = verge.at(along, KERBSIDE_M - verge.half_width)
            pieces.append((kind, (x, y, yaw, length, width, height)))
    return _by_kind(pieces)


def join_clutter(*parts: Clutter) -> Clutter:
    """Join clutter by kind."""
    return _by_kind([(kind, tuple(row)) for part in parts for kind, rows in part for row in rows.tolist()])


def _choose(mix: dict[str, float], random: np.random.Generator) -> str:
    weights = np.array(list(mix.values()))
    return list(mix)[int(random.choice(len(mix), p=weights / weights.sum()))]


def _by_kind(pieces: list[Piece]) -> Clutter:
    kinds = sorted({kind for kind, _ in pieces})
    return tuple(
        (kind, np.array([row for piece_kind, row in pieces if piece_kind == kind], np.float64)) for kind in kinds
    )


LINE_M = 0.12  # width of the lines


def outline_space(space: ParkingParameters) -> Polygon:
    """Return the outline of a parking space, world frame [m]."""
    return make_footprint(space.x, space.y, np.radians(space.yaw_deg), space.length_m, space.width_m)


def paint_spaces(spaces: Sequence[ParkingParameters]) -> Iterator[Marking]:
    """Yield the lines around parking spaces, inside their outlines, world frame [m]."""
    for space in spaces:
        inner = outline_space(space).buffer(-LINE_M / 2, join_style="mitre")
        corners = np.asarray(inner.exterior.coords)
        for i in range(4):
            yield Marking("solid", corners[i : i + 2], LINE_M, 0.0, 0.0)


def outline_objects(objects: Sequence[ObjectParameters]) -> list[Polygon]:
    """Return the footprints of objects, world frame [m]; a tree's is that of its crown."""
    return [make_footprint(item.x, item.y, np.radians(item.yaw_deg), item.length_m, item.width_m) for item in objects]


def list_buildings(objects: Sequence[ObjectParameters]) -> Array:
    """Return the buildings (B, 6) among objects: x, y, yaw, length, width, height [m, rad]."""
    return _list_rows(objects, "building")


def list_trees(objects: Sequence[ObjectParameters]) -> Array:
    """Return the trees (T, 4) among objects: x, y, height, crown radius [m]."""
    rows = _list_rows(objects, "tree")
    return np.column_stack((rows[:, 0], rows[:, 1], rows[:, 5], rows[:, 3:5].mean(axis=1) / 2))


def list_clutter(objects: Sequence[ObjectParameters]) -> tuple[tuple[str, Array], ...]:
    """Return all other objects by kind of clutter: rows (K, 6) x, y, yaw, length, width, height [m, rad]."""
    kinds = sorted({item.kind for item in objects} - {"building", "tree"})
    return tuple((kind, _list_rows(objects, kind)) for kind in kinds)


def _list_rows(objects: Sequence[ObjectParameters], kind: str) -> Array:
    rows = [
        (item.x, item.y, float(np.radians(item.yaw_deg)), item.length_m, item.width_m, item.height_m)
        for item in objects
        if item.kind == kind
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
