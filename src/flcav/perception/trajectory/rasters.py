"""Bird's-eye rasters around road users: the town's map, reachable lanes, traffic lights, and road users' tracks.

`RoadMap` is the lane-level map from which they are drawn: raster, lane centre lines, reachable lanes, traffic lights.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from scipy.spatial import KDTree
from shapely.geometry import LineString

from flcav.arrays import Array, Ints, Mask, Words
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import pose, wrap_angle
from flcav.perception.trajectory.config import PAST, STEP_S, Patch
from flcav.perception.trajectory.tracks import Tracks, into_frame, out_of_frame
from flcav.world.map.lanes import RASTER_LAYERS, map_layers, rasterise
from flcav.world.map.layers import MapLane, MapLayers
from flcav.world.map.town import Town
from flcav.world.trace import Trace

STATIC = ("road", "lane", "crossing")  # layers of the map that are used
STATIC_ROWS = tuple(RASTER_LAYERS.index(name) for name in STATIC)
RESOLUTION_M = 0.5  # of the town's raster
DOT_M = 0.7  # spacing of the points of a lane's surface, so that each cell of 1 m has a point
REACH_M = 70.0  # distance along the lanes up to which lanes are reachable
ASIDE_M, TURNED = 1.5, np.radians(40.0)  # largest distance and angle between a road user and its lane's centre line
BEFORE_M = 20.0  # distance before a junction from which a road user counts as at the junction
BAR_M = 2.0  # length along the lane of the bar of a traffic light, which spans the lane at its start


@dataclass(frozen=True)
class RoadMap:
    """Lane-level map of a town, in the world frame [m, rad]."""

    layers: MapLayers
    raster: Mask  # (len(STATIC), H, W) cells of RESOLUTION_M; row 0 at the lowest x, column 0 the lowest y
    corner: Array  # (2,) x, y of the corner of the raster's first cell
    line: KDTree  # of the points (P, 2) of the lanes' centre lines
    line_lane: Ints  # (P,) index of the lane
    line_yaw: Array  # (P,) driving direction
    line_to_junction_m: Array  # (P,) distance along the lane to a junction; 0 inside one, inf without
    reach: tuple[Array, ...]  # per lane: (D, 2) points on the surfaces of the lane and of all reachable lanes
    lights: Mapping[str, Array]  # entry of `Trace.light` -> (D, 2) points of the bars of its lanes

    def static(self, world: Array) -> Mask:
        """Return whether world points (..., 2) [m] lie in each layer (..., len(STATIC)); False outside the town."""
        cell = np.floor((world - self.corner) / RESOLUTION_M).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < self.raster.shape[1:]), axis=-1)
        row, column = np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0)
        return np.moveaxis(self.raster[:, row, column] & inside, 0, -1)

    def lanes_at(self, position: Array, yaw: Array) -> tuple[list[list[int]], Array]:
        """Return the lanes of N road users, as lists of indices, and the distances to their next junction (N,) [m].

        `position` is (N, 2) [m], `yaw` (N,) [rad]. Lanes overlap inside junctions and at their start, so that a road
        user may have several: the nearest within `ASIDE_M` and `TURNED`, and those up to 0.5 m farther. The distance is
        `inf` where no junction follows, and for a road user on no lane.
        """
        lanes = []
        distance = np.full(len(position), np.inf)
        for i, near in enumerate(self.line.query_ball_point(position, ASIDE_M)):
            near = np.array(near, dtype=np.int64)
            near = near[np.abs(wrap_angle(self.line_yaw[near] - yaw[i])) < TURNED]
            if not len(near):
                lanes.append([])
                continue
            aside = np.hypot(*(np.asarray(self.line.data)[near] - position[i]).T)
            near = near[aside <= aside.min() + 0.5]
            lanes.append(np.unique(self.line_lane[near]).tolist())
            distance[i] = self.line_to_junction_m[near].min()
        return lanes, distance


@lru_cache(maxsize=8)
def load_roads(data: Dataset) -> RoadMap:
    """Return the map of a dataset's town, cached; raises `InputError` if the town is unknown."""
    town = data.town()
    if town is None:
        raise InputError(f"{data.folder}: the map of its town is not known, which 'trajectory' needs")
    return road_map(town)


def road_map(town: Town) -> RoadMap:
    """Return the map of a town's driving and bicycle lanes."""
    layers = map_layers(town)
    lanes = [lane for lane in layers.lanes if lane.kind in ("driving", "bicycle") and len(lane.centre_line) > 1]
    number = {lane.id: i for i, lane in enumerate(lanes)}
    real = _where_streets_meet(lanes)
    points, owner, yaw, ahead = [], [], [], []
    for i, lane in enumerate(lanes):
        along, xy = _dots(lane)
        follows = any(other in number and lanes[number[other]].junction in real for other in lane.successors)
        points.append(xy)
        owner.append(np.full(len(xy), i))
        yaw.append(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
        ahead.append(np.zeros(len(xy)) if lane.junction in real else along[-1] - along if follows else along + np.inf)
    return RoadMap(
        layers=layers,
        raster=_raster(layers, town.bounds),
        corner=np.array(town.bounds[:2]),
        line=KDTree(np.concatenate(points)),
        line_lane=np.concatenate(owner),
        line_yaw=np.concatenate(yaw),
        line_to_junction_m=np.concatenate(ahead),
        reach=tuple(_reach(lanes, number)),
        lights=_bars(lanes),
    )


def _raster(layers: MapLayers, bounds: tuple[float, float, float, float]) -> Mask:
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    cells = np.ceil((high - low) / RESOLUTION_M)
    size = cells * RESOLUTION_M
    middle = pose(float(low[0] + size[0] / 2), float(low[1] + size[1] / 2))
    raster = rasterise(layers, middle, (float(size[0]), float(size[1])), RESOLUTION_M)
    return raster[list(STATIC_ROWS), ::-1, ::-1].copy()


def _where_streets_meet(lanes: Iterable[MapLane]) -> set[str]:
    """Return the ids of the junctions with a choice of exits or with merging streets; bends and dead ends are none."""
    known = {lane.id: lane for lane in lanes}
    ways: dict[str, set[tuple[str, str]]] = {}
    for lane in known.values():
        for entered in (known[after] for after in lane.successors if after in known):
            if entered.junction and not lane.junction and entered.turn != "t":
                inside = entered
                while inside.junction and inside.successors and inside.successors[0] in known:  # it may be cut in two
                    inside = known[inside.successors[0]]
                ways.setdefault(entered.junction, set()).add((_edge(lane.id), _edge(inside.id)))
    return {
        junction
        for junction, pairs in ways.items()
        if len({start for start, _ in pairs}) < len(pairs) or len({end for _, end in pairs}) < len(pairs)
    }


def _edge(lane: str) -> str:
    return lane.rpartition("_")[0]


def _reach(lanes: list[MapLane], number: Mapping[str, int]) -> Iterable[Array]:
    """Yield, per lane, the surface points of the lane and of the lanes reachable within `REACH_M` of its end."""
    surface = [_surface(lane) for lane in lanes]
    length = [LineString(lane.centre_line).length for lane in lanes]
    for start in range(len(lanes)):
        left = {start: REACH_M}  # [m] still to go at the end of a lane
        queue = [start]
        while queue:
            lane = queue.pop()
            for name in lanes[lane].successors:
                after = number.get(name)
                if (
                    after is not None
                    and lanes[after].turn != "t"
                    and left[lane] > left.get(after, -np.inf) + length[after]
                ):
                    left[after] = left[lane] - length[after]
                    if left[after] > 0:
                        queue.append(after)
        yield np.concatenate([surface[lane] for lane in sorted(left)])


def _dots(lane: MapLane) -> tuple[Array, Array]:
    """Return distances (P,) along a lane's centre line, about `DOT_M` apart, and the points (P, 2) there [m]."""
    line = LineString(lane.centre_line)
    along = np.linspace(0.0, line.length, max(2, round(line.length / DOT_M) + 1))
    return along, shapely.get_coordinates(shapely.line_interpolate_point(line, along))


def _surface(lane: MapLane) -> Array:
    _, xy = _dots(lane)
    ahead = np.gradient(xy, axis=0)
    left = np.stack((-ahead[:, 1], ahead[:, 0]), axis=1) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
    half = lane.width_m / 2
    across = np.linspace(-half, half, max(2, round(lane.width_m / DOT_M)))
    return (xy[:, None] + across[:, None] * left[:, None]).reshape(-1, 2)


def _bars(lanes: Iterable[MapLane]) -> dict[str, Array]:
    bars: dict[str, list[Array]] = {}
    for lane in lanes:
        if lane.light:
            start, after = lane.centre_line[:2]
            ahead = (after - start) / np.linalg.norm(after - start)
            left = np.array((-ahead[1], ahead[0]))
            along, across = np.meshgrid(
                np.arange(0.0, BAR_M, DOT_M), np.linspace(-lane.width_m / 2, lane.width_m / 2, 5), indexing="ij"
            )
            bars.setdefault(lane.light, []).append(start + along.reshape(-1, 1) * ahead + across.reshape(-1, 1) * left)
    return {light: np.concatenate(points) for light, points in bars.items()}


AGO = (0, 4, 8)  # steps before the present at which other road users are drawn: 0, 1 and 2 s
OTHERS = {steps: f"others {steps * STEP_S:g} s ago" for steps in AGO}
LAYERS = (
    *STATIC,
    "way",  # lanes that are reachable from the road user's lanes
    "red",  # bars across the lanes whose light is not green
    "green",
    "self",
    *OTHERS.values(),
    "pedestrian",
)
OPEN = ("G", "g")  # SUMO's letters of a green light
_LONG, _WIDE = np.meshgrid(np.linspace(-0.5, 0.5, 17), np.linspace(-0.5, 0.5, 5), indexing="ij")
BODY = np.stack((_LONG, _WIDE), axis=-1).reshape(-1, 2)  # points inside a box, as shares of its length and width


def draw_rasters(trace: Trace, tracks: Tracks, lit: Words, predicted: Ints, roads: RoadMap, patch: Patch) -> Mask:
    """Return the rasters (N, len(LAYERS), cells, cells) around the actors `predicted` (N,), as indices into `trace`.

    `tracks` have the present at index `PAST`; `lit` (L,) are SUMO's letters of the lights at the present. Row 0 is
    farthest ahead and column 0 farthest left, as in `flcav.world.map.lanes`.
    """
    frame = np.concatenate((tracks.position[PAST, predicted], tracks.yaw[PAST, predicted, None]), axis=1)
    sheets = RasterCanvas(frame, patch)
    if len(predicted):
        _mark_map(sheets, roads)
        _mark_lights(sheets, roads, trace, lit)
        sheets.mark("self", np.arange(len(predicted)), _bodies(trace, tracks, PAST, predicted))
        on_foot = trace.category == "pedestrian"
        for steps in AGO:
            _mark_others(sheets, OTHERS[steps], trace, tracks, predicted, PAST - steps, ~on_foot)
        _mark_others(sheets, "pedestrian", trace, tracks, predicted, PAST, on_foot)
    return sheets.cells.reshape(len(predicted), len(LAYERS), patch.cells, patch.cells)


class RasterCanvas:
    """The rasters of N road users while being drawn; `cells` (N, len(LAYERS), cells * cells) is changed in place."""

    def __init__(self, frame: Array, patch: Patch) -> None:
        """Create empty rasters; `frame` (N, 3) are the road users' poses x, y, yaw in the world."""
        self.frame, self.patch = frame, patch
        self.cells = np.zeros((len(frame), len(LAYERS), patch.cells**2), np.bool_)

    def mark(self, layer: str, rows: Ints, world: Array) -> None:
        """Set the cells of world points (R, D, 2) [m] in a layer of the rasters `rows` (R,)."""
        at, inside = cell_of(into_frame(world, self.frame[rows]), self.patch)
        sheet = np.broadcast_to(rows[:, None], at.shape)
        self.cells[sheet[inside], LAYERS.index(layer), at[inside]] = True


def _mark_map(sheets: RasterCanvas, roads: RoadMap) -> None:
    frame = sheets.frame
    grid = np.broadcast_to(centres(sheets.patch), (len(frame), sheets.patch.cells**2, 2))
    sheets.cells[:, : len(STATIC)] = roads.static(out_of_frame(grid, frame)).transpose(0, 2, 1)
    ways, _ = roads.lanes_at(frame[:, :2], frame[:, 2])
    for row, lanes in enumerate(ways):
        if lanes:
            sheets.mark("way", np.array([row]), np.concatenate([roads.reach[lane] for lane in lanes])[None])


def _mark_lights(sheets: RasterCanvas, roads: RoadMap, trace: Trace, lit: Words) -> None:
    everyone = np.arange(len(sheets.frame))
    for layer, wanted in (("green", True), ("red", False)):
        bars = _light_bars(roads, trace.light, lit, wanted)
        sheets.mark(layer, everyone, np.broadcast_to(bars, (len(everyone), *bars.shape)))


def _mark_others(
    sheets: RasterCanvas,
    layer: str,
    trace: Trace,
    tracks: Tracks,
    predicted: Ints,
    instant: int,
    kind: Mask,
) -> None:
    """Draw the bodies of the near actors of a `kind` (A,) at an instant, without the predicted road user."""
    apart = tracks.position[instant][None] - sheets.frame[:, None, :2]
    near = (np.abs(apart) < sheets.patch.side_m).all(axis=2) & kind  # False for NaN, the absent ones
    near[np.arange(len(predicted)), predicted] = False
    row, other = np.nonzero(near)
    sheets.mark(layer, row, _bodies(trace, tracks, instant, other))


def centres(patch: Patch) -> Array:
    """Return the centres (cells * cells, 2) of a patch's cells in the road user's frame [m], row by row."""
    low = patch.middle_x_m - patch.side_m / 2
    steps = (np.arange(patch.cells, dtype=np.float64) + 0.5) * patch.cell_m
    along, across = low + steps[::-1], patch.side_m / 2 - steps
    return np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)


def cell_of(points: Array, patch: Patch) -> tuple[Ints, Mask]:
    """Return the cell indices (...) of points (..., 2) in the road user's frame [m], and whether they are in it."""
    ahead, left = patch.middle_x_m + patch.side_m / 2, patch.side_m / 2
    row = np.floor((ahead - points[..., 0]) / patch.cell_m).astype(np.int64)
    column = np.floor((left - points[..., 1]) / patch.cell_m).astype(np.int64)
    inside = (row >= 0) & (row < patch.cells) & (column >= 0) & (column < patch.cells)
    return row * patch.cells + column, inside


def _light_bars(roads: RoadMap, lights: Words, lit: Words, wanted: bool) -> Array:
    bars: Sequence[Array] = [
        roads.lights[name]
        for name, letter in zip(lights.tolist(), lit.tolist())
        if name in roads.lights and (letter in OPEN) == wanted
    ]
    return np.concatenate(bars) if bars else np.zeros((0, 2))


def _bodies(trace: Trace, tracks: Tracks, instant: int, actors: Ints) -> Array:
    """Return points (N, len(BODY), 2) inside the actors' boxes, in the world frame [m]."""
    pose = np.concatenate((tracks.position[instant, actors], tracks.yaw[instant, actors, None]), axis=1)
    return out_of_frame(BODY * trace.size[actors, None, :2], pose)
