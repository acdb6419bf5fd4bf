"""Bridges of an OpenDRIVE map: where its roads pass above others."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flcav.arrays import Array, Ints, Mask

BRIDGE_M = 2.5  # a road at least this far above another one passes over it
CLEAR_M = 4.0  # from the end of a deck to the road below, seen from above
JOINT_M = 0.5  # pieces of roads no farther apart than this go on as one bridge
NEAR_M = 12.0  # the ground is sampled closely so far around a deck
BATCH = 20_000  # pieces of roads that are compared with all others at a time


class Borders(NamedTuple):
    """The K cross-sections of a road by their ends."""

    right: Array  # (K, 3) [m]
    left: Array  # (K, 3) [m]


class Spans(NamedTuple):
    """The bridges of one road with K cross-sections."""

    decks: tuple[slice, ...]  # the cross-sections of each deck, those at both ends included
    near: Mask  # (K,) cross-sections that the ground keeps, since they are within `NEAR_M` of a deck of any road


def find_bridges(roads: Sequence[Borders]) -> list[Spans]:
    """Return the bridges of each road: where it lies `BRIDGE_M` or more above another road, or above itself.

    A deck begins and ends `CLEAR_M` before the road below, and goes on over joints of roads.
    """
    counts = [max(len(road.right) - 1, 0) for road in roads]
    pieces = _join_corners(roads)
    over, near = np.zeros((2, len(pieces)), np.bool_)
    if len(pieces) and np.ptp(pieces[..., 2]) >= BRIDGE_M:
        corners = shapely.multipoints(pieces[..., :2].reshape(-1, 2), indices=np.repeat(np.arange(len(pieces)), 4))
        areas = np.asarray(shapely.convex_hull(corners))
        tree = shapely.STRtree(areas)
        above, crossing = np.zeros((2, len(pieces)), np.bool_)
        low, high = pieces[..., 2].min(axis=1), pieces[..., 2].max(axis=1)
        for upper, lower in _batches(tree, areas, np.arange(len(areas)), CLEAR_M):
            passing = low[upper] - high[lower] >= BRIDGE_M
            upper, lower = upper[passing], lower[passing]
            above[upper] = True
            crossing[upper[shapely.intersects(areas[upper], areas[lower])]] = True
        raised = np.flatnonzero(above)
        over[raised] = _find_joined(areas[raised], low[raised], high[raised], crossing[raised])
        for _, close in _batches(tree, areas, np.flatnonzero(over), NEAR_M):
            near[close] = True
    splits = np.cumsum(counts)[:-1]
    return [_span(*parts) for parts in zip(np.split(over, splits), np.split(near, splits))]


def _join_corners(roads: Sequence[Borders]) -> Array:
    """Return the corners (N, 4, 3) of the pieces of all roads, each between two neighbouring cross-sections."""
    pieces = [np.stack((road.right[:-1], road.right[1:], road.left[1:], road.left[:-1]), axis=1) for road in roads]
    return np.concatenate(pieces) if pieces else np.zeros((0, 4, 3))


def _batches(tree: shapely.STRtree, areas: NDArray, rows: Ints, within_m: float) -> Iterator[tuple[Ints, Ints]]:
    """Yield pairs of rows of `areas`: some of `rows`, and those of the tree within `within_m` of them."""
    for first in range(0, len(rows), BATCH):
        some = rows[first : first + BATCH]
        one, other = tree.query(areas[some], predicate="dwithin", distance=within_m)
        yield some[one], other


def _find_joined(areas: NDArray, low: Array, high: Array, crossing: Mask) -> Mask:
    """Return which of N pieces of roads are `crossing`, or joined with such a piece, at once or by others of them.

    `low` and `high` (N,) are their heights [m].
    """
    if not crossing.any():
        return crossing
    links = [np.zeros((2, 0), np.int64)]
    for one, other in _batches(shapely.STRtree(areas), areas, np.arange(len(areas)), JOINT_M):
        alike = np.maximum(low[one] - high[other], low[other] - high[one]) < BRIDGE_M
        links.append(np.stack((one[alike], other[alike])))
    rows = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(rows.shape[1]), tuple(rows)), shape=(len(areas), len(areas)))
    group = connected_components(graph, directed=False)[1]
    return np.isin(group, group[crossing])


def _span(over: Mask, near: Mask) -> Spans:
    """Return the bridges of a road, given which of its K - 1 pieces are `over` another one and which are `near`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], over, [False]))))
    decks = tuple(slice(int(first), int(last) + 1) for first, last in edges.reshape(-1, 2))
    return Spans(decks, np.concatenate((near, [False])) | np.concatenate(([False], near)))
