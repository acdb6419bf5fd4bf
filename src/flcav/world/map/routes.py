"""Routes: the centre lines of lanes that lead on from each other, through a town's streets and junctions."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.config import InputError
from flcav.world.map.roads import Connection, Edge, Lane, RoadNet

Array = NDArray[np.float64]

SHORTEST_M = 20.0  # a route begins on a lane that is longer
WINDOW_M = 30.0  # a place on a route is looked for so far from the last one


@dataclass(frozen=True)
class Route:
    """The centre line of a route through a town."""

    points: Array  # (K, 2) [m]
    along: Array  # (K,) distance from the start [m], ascending
    speed: Array  # (K,) limit from each point on [m/s]
    stops: tuple[tuple[float, str], ...]  # where traffic lights are passed: distance [m], the entry of `Trace.light`

    @property
    def length_m(self) -> float:
        """Return the length [m]."""
        return float(self.along[-1])

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances; straight on beyond the ends."""
        along = np.asarray(along, np.float64)
        piece = np.clip(np.searchsorted(self.along, along, side="right") - 1, 0, len(self.along) - 2)
        step = self.points[piece + 1] - self.points[piece]
        share = (along - self.along[piece]) / (self.along[piece + 1] - self.along[piece])
        heading = np.arctan2(step[..., 1], step[..., 0])
        return np.concatenate((self.points[piece] + share[..., None] * step, heading[..., None]), axis=-1)

    def limit(self, along: float) -> float:
        """Return the speed limit [m/s] at a distance."""
        return float(self.speed[max(int(np.searchsorted(self.along, along, side="right")) - 1, 0)])

    def project(self, x: float, y: float, near: float) -> tuple[float, float]:
        """Return how far along the route, and how far to its left [m], a place is; looked for about `near` [m]."""
        start, step = self.points[:-1], np.diff(self.points, axis=0)
        length = np.diff(self.along)
        share = np.clip(((np.array((x, y)) - start) * step).sum(axis=1) / length**2, 0.0, 1.0)
        away = np.array((x, y)) - start - share[:, None] * step
        far = (self.along[1:] < near - WINDOW_M) | (self.along[:-1] > near + WINDOW_M)
        nearest = int(np.argmin(np.where(far, np.inf, np.linalg.norm(away, axis=1))))
        left = step[nearest, 0] * away[nearest, 1] - step[nearest, 1] * away[nearest, 0]
        side = float(np.copysign(np.linalg.norm(away[nearest]), left))
        return float(self.along[nearest] + share[nearest] * length[nearest]), side


def draw_route(net: RoadNet, random: np.random.Generator, length_m: float) -> Route:
    """Return a route of at least `length_m` [m], or to where the net ends, with its lanes drawn uniformly.

    Raises `InputError` where the net has no driving lane of `SHORTEST_M`.
    """
    lanes = {lane.id: (edge, lane) for edge in net.edges.values() for lane in edge.lanes_of("driving")}
    onward: dict[str, list[Connection]] = {}
    for way in net.connections:
        if way.end in lanes and (not way.via or way.via in lanes):
            onward.setdefault(way.start, []).append(way)
    starts = [
        name for name, (edge, lane) in lanes.items() if edge.function == "normal" and _length(lane.shape) > SHORTEST_M
    ]
    if not starts:
        raise InputError(f"no driving lane is longer than {SHORTEST_M:g} m")
    name = starts[int(random.integers(len(starts)))]
    parts, stops, driven = [lanes[name]], [], _length(lanes[name][1].shape)
    while driven < length_m and (ways := onward.get(name)):
        way = ways[int(random.integers(len(ways)))]
        if way.light:
            stops.append((driven, way.light))
        for part in _through(way, lanes, onward):
            parts.append(part)
            driven += _length(part[1].shape)
        name = way.end
    return _join([lane for _, lane in parts], tuple(stops))


def _through(
    way: Connection, lanes: dict[str, tuple[Edge, Lane]], onward: dict[str, list[Connection]]
) -> Iterator[tuple[Edge, Lane]]:
    """Yield the lanes inside a junction that lead to the end of a connection, and that end."""
    via = way.via
    while via:
        yield lanes[via]
        via = next((each.via for each in onward.get(via, ()) if each.end == way.end), "")
    yield lanes[way.end]


def _join(lanes: list[Lane], stops: tuple[tuple[float, str], ...]) -> Route:
    points = np.concatenate([lane.shape for lane in lanes])
    speed = np.concatenate([np.full(len(lane.shape), lane.speed) for lane in lanes])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    kept = np.concatenate(([True], steps > 1e-3))
    points, speed = points[kept], speed[kept]
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    return Route(points, along, speed, stops)


def _length(shape: Array) -> float:
    return float(np.linalg.norm(np.diff(shape, axis=0), axis=1).sum())
