"""Walkers of CARLA's `controller.ai.walker`: they walk along the town's footpaths and crossings.

CARLA's own walk over a navigation mesh, which a client gets from its server; there is none here.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from shapely.geometry import LineString

from flcav.statistics.streams import stream
from flcav.world.map.roads import RoadNet

Array = NDArray[np.float64]

STEP_M = 2.0  # between two points of a path
JOINED_M = 6.0  # ends of paths so near to each other are linked
REACHED_M = 0.6
SPEED_MPS = 1.4


class Footpaths:
    """The footpaths of a town as points with their neighbours."""

    def __init__(self, net: RoadNet) -> None:
        """Take the sidewalks and crossings of a net."""
        points: list[Array] = []
        self._next: list[list[int]] = []
        ends: list[int] = []
        for edge in net.edges.values():
            for lane in edge.lanes:
                if lane.kind not in ("sidewalk", "crossing"):
                    continue
                line = LineString(lane.shape)
                count = max(2, int(line.length // STEP_M) + 1)
                first = len(points)
                points += [np.array(line.interpolate(i / (count - 1), normalized=True).coords[0]) for i in range(count)]
                self._next += [
                    [i + d for d in (-1, 1) if first <= i + d < first + count] for i in range(first, first + count)
                ]
                ends += [first, first + count - 1]
        self.points = np.array(points).reshape(-1, 2)
        if ends:
            tree = KDTree(self.points[ends])
            for one, other in tree.query_pairs(JOINED_M):
                self._next[ends[one]].append(ends[other])
                self._next[ends[other]].append(ends[one])
        self._tree = KDTree(self.points) if len(points) else None

    def find_nearest(self, place: Array) -> int | None:
        """Return the point nearest to a place (2,); None without paths."""
        return None if self._tree is None else int(self._tree.query(place)[1])

    def choose_next(self, at: int, before: int | None, rng: np.random.Generator) -> int:
        """Return a neighbour of a point, not the one before where there are others."""
        ways = [each for each in self._next[at] if each != before] or self._next[at]
        return ways[int(rng.integers(len(ways)))]


class Stroll:
    """One walker's way along the paths."""

    def __init__(self, paths: Footpaths, place: Array, seed: int, number: int) -> None:
        """Begin at the path nearest to a place (2,)."""
        self._paths = paths
        self._rng = stream(seed, "carla", "stroll", number)
        self._before: int | None = None
        self._aim = paths.find_nearest(place)

    def choose_velocity(self, place: Array) -> tuple[float, float]:
        """Return the velocity (2,) [m/s] of the walker at a place (2,)."""
        if self._aim is None:
            return (0.0, 0.0)
        way = self._paths.points[self._aim] - place
        if np.hypot(*way) < REACHED_M:
            self._before, self._aim = self._aim, self._paths.choose_next(self._aim, self._before, self._rng)
            way = self._paths.points[self._aim] - place
        way = SPEED_MPS * way / max(float(np.hypot(*way)), 1e-6)
        return float(way[0]), float(way[1])
