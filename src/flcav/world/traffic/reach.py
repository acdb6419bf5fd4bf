"""Reachability in a road net: which edges a vehicle or a pedestrian can get to from which."""

import networkx
import numpy as np
from numpy.typing import NDArray

from flcav.world.map.roads import Edge, RoadNet


def make_drive_graph(net: RoadNet, edges: list[Edge]) -> networkx.DiGraph:
    """Return the graph of the edges that vehicles can drive on, the `edges` first, and which leads to which."""
    graph = networkx.DiGraph()
    graph.add_nodes_from(edge.id for edge in edges)
    driven = {lane.id for edge in net.edges.values() for lane in edge.lanes_of("driving")}
    for way in net.connections:
        if way.start in driven and way.end in driven:
            graph.add_edge(_edge(way.start), _edge(way.end))
    return graph


def find_driven(net: RoadNet, edges: list[Edge]) -> NDArray[np.bool_]:
    """Return (N, N) whether a vehicle can drive from each of the `edges` to each of them; in a circle to itself."""
    graph = make_drive_graph(net, edges)
    row = {edge.id: i for i, edge in enumerate(edges)}
    whole = networkx.condensation(graph)
    out = np.zeros((len(edges), len(edges)), np.bool_)
    onward: dict[int, NDArray[np.bool_]] = {}  # of each strongly connected part, the edges from there on
    for part in reversed(list(networkx.topological_sort(whole))):
        members = whole.nodes[part]["members"]
        mask = np.zeros(len(edges), np.bool_)
        for following in whole.successors(part):
            mask |= onward[following]
        cyclic = len(members) > 1 or any(graph.has_edge(name, name) for name in members)
        own = [row[name] for name in members if name in row]
        mask[own] |= cyclic
        out[own] = mask
        mask = mask.copy()
        mask[own] = True
        onward[part] = mask
    return out


def find_walked(net: RoadNet, edges: list[Edge]) -> NDArray[np.bool_]:
    """Return (N, N) whether a pedestrian can walk between each two of the `edges`, by sidewalks and crossings."""
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
