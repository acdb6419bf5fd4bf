"""Bridges of an OpenDRIVE map: where its roads pass above others."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BRIDGE_M = 2.5  # a road at least this far above another one passes over it
CLEAR_M = 4.0  # from the end of a deck to the road below, seen from above
NEAR_M = 12.0  # the ground is sampled closely so far around a deck
BATCH = 20_000  # pieces of roads that are compared with all others at a time


class Borders(NamedTuple):
    """The K cross-sections of a road by their ends."""

    right: Array  # (K, 3) [m]
    left: Array  # (K, 3) [m]


class Spans(NamedTuple):
    """The bridges of one road with K cross-sections."""

    decks: tuple[slice, ...]  # the cross-sections of each deck, those at both ends included
    near: Mask  # (K,) cross-sections within `NEAR_M` of a deck of any road


def find_bridges(roads: Sequence[Borders]) -> list[Spans]:
    """Return the bridges of each road: where it lies `BRIDGE_M` or more above another road.

    A deck begins and ends `CLEAR_M` before the road below. A road that passes over itself has none.
    """
    counts = [max(len(road.right) - 1, 0) for road in roads]
    owner = np.repeat(np.arange(len(roads)), counts)
    over, near = np.zeros((2, len(owner)), np.bool_)
    pieces = _join_corners(roads)
    if len(pieces) and np.ptp(pieces[..., 2]) >= BRIDGE_M:
        corners = shapely.multipoints(pieces[..., :2].reshape(-1, 2), indices=np.repeat(np.arange(len(pieces)), 4))
        areas = np.asarray(shapely.convex_hull(corners))
        tree = shapely.STRtree(areas)
        above, crossing = np.zeros((2, len(pieces)), np.bool_)
        low, high = pieces[..., 2].min(axis=1), pieces[..., 2].max(axis=1)
        for upper, lower in _batches(tree, areas, np.arange(len(areas)), CLEAR_M):
            passing = (owner[upper] != owner[lower]) & (low[upper] - high[lower] >= BRIDGE_M)
            upper, lower = upper[passing], lower[passing]
            above[upper] = True
            crossing[upper[shapely.intersects(areas[upper], areas[lower])]] = True
        run = np.cumsum(np.diff(above, prepend=False) | (np.diff(owner, prepend=-1) != 0))
        over = above & np.isin(run, run[crossing])
        for _, close in _batches(tree, areas, np.flatnonzero(over), NEAR_M):
            near[close] = True
    splits = np.cumsum(counts)[:-1]
    return [_span(*parts) for parts in zip(np.split(over, splits), np.split(near, splits))]


def _join_corners(roads: Sequence[Borders]) -> Array:
    """Return the corners (N, 4, 3) of the pieces of all roads, each between two neighbouring cross-sections."""
    pieces = [np.stack((road.right[:-1], road.right[1:], road.left[1:], road.left[:-1]), axis=1) for road in roads]
    return np.concatenate(pieces) if pieces else np.zeros((0, 4, 3))


def _batches(
    tree: shapely.STRtree, areas: NDArray, rows: NDArray[np.int64], within_m: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield pairs of rows of `areas`: some of `rows`, and those of the tree within `within_m` of them."""
    for first in range(0, len(rows), BATCH):
        some = rows[first : first + BATCH]
        one, other = tree.query(areas[some], predicate="dwithin", distance=within_m)
        yield some[one], other


def _span(over: Mask, near: Mask) -> Spans:
    """Return the bridges of a road, given which of its K - 1 pieces are `over` another one and which are `near`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], over, [False]))))
    decks = tuple(slice(int(first), int(last) + 1) for first, last in edges.reshape(-1, 2))
    return Spans(decks, np.concatenate((near, [False])) | np.concatenate(([False], near)))
