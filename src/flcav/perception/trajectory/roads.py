"""Lane-level map of a town for trajectory prediction: raster, lane centre lines, reachable lanes, traffic lights."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree
from shapely.geometry import LineString

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import pose, wrap_angle
from flcav.world.map.lanes import RASTER_LAYERS, map_layers, rasterise
from flcav.world.map.layers import MapLane, MapLayers
from flcav.world.map.town import Town

Array = NDArray[np.float64]

STATIC = ("road", "lane", "crossing")  # layers of the map that are used
STATIC_ROWS = tuple(RASTER_LAYERS.index(name) for name in STATIC)
RESOLUTION_M = 0.5  # of the town's raster
DOT_M = 0.7  # spacing of the points of a lane's surface, so that each cell of 1 m has a point
REACH_M = 70.0  # distance along the lanes up to which lanes are reachable
ASIDE_M, TURNED = 1.5, np.radians(40.0)  # largest distance and angle between a road user and its lane's centre line
BEFORE_M = 20.0  # distance before a junction from which on a road user is at the junction
BAR_M = 2.0  # length along the lane of the bar of a traffic light, which spans the lane at its start


@dataclass(frozen=True)
class RoadMap:
    """Map of a town with its lanes, all in the world's frame [m, rad]."""

    layers: MapLayers
    raster: NDArray[np.bool_]  # (len(STATIC), H, W) cells of RESOLUTION_M; row 0 at the lowest x, column 0 the lowest y
    corner: Array  # (2,) x, y of the corner of the raster's first cell
    line: KDTree  # of the (P, 2) points of the lanes' centre lines
    line_lane: NDArray[np.int64]  # (P,) index of the lane
    line_yaw: Array  # (P,) driving direction
    line_to_junction_m: Array  # (P,) distance along the lane to a junction; 0 inside one, inf without
    reach: tuple[Array, ...]  # of each lane: (D, 2) points of the surfaces of the lane and of all reachable lanes
    lights: Mapping[str, Array]  # entry of `Trace.light` -> (D, 2) points of the bars of its lanes

    def static(self, world: Array) -> NDArray[np.bool_]:
        """Return (..., len(STATIC)) whether world points (..., 2) lie in each layer; False outside the town."""
        cell = np.floor((world - self.corner) / RESOLUTION_M).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < self.raster.shape[1:]), axis=-1)
        row, column = np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0)
        return np.moveaxis(self.raster[:, row, column] & inside, 0, -1)

    def lanes_at(self, position: Array, yaw: Array) -> tuple[list[list[int]], Array]:
        """Return the lanes of each of N road users, lists of indices, and the distance to the next junction (N,) [m].

        `position` is (N, 2), `yaw` (N,). Lanes overlap inside junctions and at their start, so a road user may have
        several: the nearest within `ASIDE_M` and `TURNED`, and those up to 0.5 m farther. The distance is `inf` if no
        junction follows, and for a road user on no lane.
        """
        lanes, distance = [], np.full(len(position), np.inf)
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
    """Return the map of a town, of its driving and bicycle lanes."""
    layers = map_layers(town)
    lanes = [lane for lane in layers.lanes if lane.kind in ("driving", "bicycle") and len(lane.centre_line) > 1]
    number = {lane.id: i for i, lane in enumerate(lanes)}
    real = _where_streets_meet(lanes)
    points, owner, yaw, ahead = [], [], [], []
    for i, lane in enumerate(lanes):
        line = LineString(lane.centre_line)
        along = np.linspace(0.0, line.length, max(2, round(line.length / DOT_M) + 1))
        xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
        follows = any(other in number and lanes[number[other]].junction in real for other in lane.successors)
        points.append(xy)
        owner.append(np.full(len(xy), i))
        yaw.append(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
        ahead.append(np.zeros(len(xy)) if lane.junction in real else line.length - along if follows else along + np.inf)
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


def _raster(layers: MapLayers, bounds: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    cells = np.ceil((high - low) / RESOLUTION_M)
    size = cells * RESOLUTION_M
    middle = pose(float(low[0] + size[0] / 2), float(low[1] + size[1] / 2))
    found = rasterise(layers, middle, (float(size[0]), float(size[1])), RESOLUTION_M)
    return found[list(STATIC_ROWS), ::-1, ::-1].copy()


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
    """Yield, for each lane, the surface points of the lane and of the lanes reachable within `REACH_M` of its end."""
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


def _surface(lane: MapLane) -> Array:
    line = LineString(lane.centre_line)
    along = np.linspace(0.0, line.length, max(2, round(line.length / DOT_M) + 1))
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
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
