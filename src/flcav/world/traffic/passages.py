"""Reachability in a road net, and passages: routes from the entries of an open net to its exits."""

from dataclasses import dataclass, replace

import networkx
import numpy as np
from shapely.geometry import LineString

from flcav.arrays import Array, Mask
from flcav.config import InputError
from flcav.world.map.roads import Edge, RoadNet

HASTE = 1.2  # highest speed of a car, as a multiple of the limit
ENTERING_S = 1.0  # time that is lost since a vehicle enters with its whole length, and leaves with its front
SHORT_S = 10.0  # a route that takes less time at the limit is driven more slowly if a drive has to last longer
SLOWEST = 1.0  # least speed on such a route [m/s]
ENTERING_M, LEAVING_S = 6.0, 0.6  # parts of such a route that are not driven: a vehicle's length, and the last moments
ALIKE = 1.05  # factor of lengths up to which two routes count as equally long


@dataclass(frozen=True)
class Passages:
    """The N driven edges of a net, their successors, and the longest remaining driving times."""

    edges: list[Edge]
    onward: list[list[int]]  # per edge, the rows of its successors
    time_s: Array  # (N,) travel time on the edge at the limit [s]
    left_s: Array  # (N,) longest travel time from the edge's beginning to an exit [s]; infinite on a cycle
    entries: Mask  # (N,) whether the edge has no predecessor

    def slow_down(self, least_s: float) -> tuple["Passages", float | None]:
        """Return the passages at the speed at which the longest route takes `least_s` [s], and its share of the limit.

        The latter is None if the route is long enough for a vehicle of any speed, if it is not short, and if the speed
        would be too low.
        """
        longest, enough = float(self.left_s.max(initial=0.0)), HASTE * (least_s + ENTERING_S)
        share = self._measure_crawl() * SLOWEST / self._limit / (least_s + LEAVING_S)
        if longest >= min(enough, SHORT_S) or share * self._limit < SLOWEST:
            return self, None
        slower = ALIKE * enough / longest
        return replace(self, time_s=slower * self.time_s, left_s=slower * self.left_s), min(share, 1.0)

    @property
    def _limit(self) -> float:
        """The speed limit at the beginning of the longest route [m/s]."""
        return self.edges[int(self.left_s.argmax())].lanes_of("driving")[0].speed

    def _measure_crawl(self) -> float:
        """Return the longest time for which a vehicle can drive at `SLOWEST` [s]."""
        return max(float(self.left_s.max(initial=0.0)) * self._limit - ENTERING_M, 0.0) / SLOWEST

    def draw(self, weight: Array, random: np.random.Generator, *, least_s: float, most_s: float) -> list[int]:
        """Draw a route (rows) that takes `least_s` [s] even at `HASTE`, and continues for `most_s` [s] or to an exit.

        The first edge is drawn by `weight` (N,), the following ones uniformly, among those that lead far enough. Raises
        `InputError` where none does.
        """
        left = HASTE * (least_s + ENTERING_S) if least_s else 0.0
        most = max(left, most_s)
        share = weight * (self.left_s >= left)
        if not share.any():
            share = 1.0 * (self.left_s >= left)
        if not share.any():
            metres, longest = sum(measure_edge(edge) for edge in self.edges), float(self.left_s.max(initial=0.0))
            slowly = f", and {max(self._measure_crawl() - LEAVING_S, 0.0):.3g} s at {SLOWEST:g} m/s"
            raise InputError(
                f"a vehicle would have to drive for {least_s:.3g} s, and its longest way out of the {metres:.0f} m "
                f"of lanes takes {longest / HASTE:.3g} s{slowly if longest < SHORT_S else ''}: record a shorter time, "
                "or fewer vehicles"
            )
        at = int(random.choice(len(self.edges), p=share / share.sum()))
        route = [at]
        driven_s = self.time_s[at]
        while self.onward[at] and driven_s < most:
            far = [row for row in self.onward[at] if self.left_s[row] >= left - driven_s]
            at = far[int(random.integers(len(far)))]
            route.append(at)
            driven_s += self.time_s[at]
        return route


def find_passages(net: RoadNet, edges: list[Edge]) -> Passages:
    """Return the passages through a net by its driven `edges`."""
    row = {edge.id: i for i, edge in enumerate(edges)}
    graph = make_drive_graph(net, edges).subgraph(row)
    time_s = np.array([measure_edge(edge) / edge.lanes_of("driving")[0].speed for edge in edges])
    left_s = np.zeros(len(edges))
    # The condensation has no cycles: in reverse topological order, all successors of a part are already known.
    whole = networkx.condensation(graph)
    for part in reversed(list(networkx.topological_sort(whole))):
        names = whole.nodes[part]["members"]
        circle = len(names) > 1 or any(graph.has_edge(name, name) for name in names)
        for name in names:
            following = [left_s[row[other]] for other in graph.successors(name) if other not in names]
            left_s[row[name]] = np.inf if circle else time_s[row[name]] + max(following, default=0.0)
    onward = [sorted(row[name] for name in graph.successors(edge.id)) for edge in edges]
    entries = np.array([not any(graph.predecessors(edge.id)) for edge in edges])
    return Passages(edges, onward, time_s, left_s, entries)


def measure_edge(edge: Edge) -> float:
    """Return the length of an edge's outermost driving lane [m]."""
    return LineString(edge.lanes_of("driving")[0].shape).length


def make_drive_graph(net: RoadNet, edges: list[Edge]) -> networkx.DiGraph:
    """Return the directed graph of the edges that vehicles can drive on, with `edges` first."""
    graph = networkx.DiGraph()
    graph.add_nodes_from(edge.id for edge in edges)
    driven = {lane.id for edge in net.edges.values() for lane in edge.lanes_of("driving")}
    for way in net.connections:
        if way.start in driven and way.end in driven:
            graph.add_edge(_edge(way.start), _edge(way.end))
    return graph


def find_driven(net: RoadNet, edges: list[Edge]) -> Mask:
    """Return (N, N) whether a vehicle can drive from one of the `edges` (row) to another or itself (column)."""
    graph = make_drive_graph(net, edges)
    row = {edge.id: i for i, edge in enumerate(edges)}
    whole = networkx.condensation(graph)
    out = np.zeros((len(edges), len(edges)), np.bool_)
    onward: dict[int, Mask] = {}  # strongly connected component -> edges reachable from it, with its members
    for part in reversed(list(networkx.topological_sort(whole))):
        members = whole.nodes[part]["members"]
        mask = np.zeros(len(edges), np.bool_)
        for following in whole.successors(part):
            mask |= onward[following]
        cyclic = len(members) > 1 or any(graph.has_edge(name, name) for name in members)
        rows = [row[name] for name in members if name in row]
        mask[rows] |= cyclic
        out[rows] = mask
        mask = mask.copy()
        mask[rows] = True
        onward[part] = mask
    return out


def find_walked(net: RoadNet, edges: list[Edge]) -> Mask:
    """Return (N, N) whether a pedestrian can walk between two of the `edges`, by sidewalks and crossings."""
    graph = networkx.Graph()
    graph.add_nodes_from(edge.id for edge in edges)
    walked = {
        lane.id
        for edge in net.edges.values()
        for lane in edge.lanes
        if lane.kind in ("sidewalk", "crossing", "walkingarea")
    }
    for way in net.connections:
        if way.start in walked and way.end in walked:
            graph.add_edge(_edge(way.start), _edge(way.end))
    part = {name: i for i, names in enumerate(networkx.connected_components(graph)) for name in names}
    number = np.array([part[edge.id] for edge in edges], np.int64)
    return number[:, None] == number


def _edge(lane: str) -> str:
    return lane.rpartition("_")[0]
