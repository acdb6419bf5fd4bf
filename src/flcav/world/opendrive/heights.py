"""Sampling of the surface of an OpenDRIVE map as points of a terrain, and its bridges (`flcav.world.map.relief`)."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError, shorten
from flcav.world.map.relief import Relief
from flcav.world.opendrive.document import OPEN_ROADS, describe_map
from flcav.world.opendrive.road_surface import Road
from flcav.world.opendrive.standard import FARTHEST_M
from flcav.world.opendrive.streets import SIDEWALK_M, WALKED

BRIDGE_M = 2.5  # least height of a road over another one that it passes on a bridge
CLEAR_M = 4.0  # horizontal distance from the end of a deck to the road below
JOINT_M = 0.5  # largest distance in plan of two pieces of road that are part of one bridge
NEAR_M = 12.0  # distance around a deck within which the ground is sampled closely
BATCH = 20_000  # number of pieces of road that are compared with all others at a time


class Borders(NamedTuple):
    """Both ends of the K cross-sections of a road, in the map's frame."""

    right: Array  # (K, 3) right ends, seen along s [m]
    left: Array  # (K, 3) left ends [m]


class Spans(NamedTuple):
    """The bridges of one road with K cross-sections."""

    decks: tuple[slice, ...]  # indices of the cross-sections of each deck, both ends included
    near: Mask  # (K,) whether the ground keeps a cross-section, since it is within `NEAR_M` of a deck of any road


def find_bridges(roads: Sequence[Borders]) -> list[Spans]:
    """Find the bridges of each road: where it lies `BRIDGE_M` or more above another road, or above itself.

    A deck begins and ends `CLEAR_M` before the road below, and continues over joints of roads.
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
    """Return the corners (N, 4, 3) [m] of the N pieces of all roads, each between two neighbouring cross-sections."""
    pieces = [np.stack((road.right[:-1], road.right[1:], road.left[1:], road.left[:-1]), axis=1) for road in roads]
    return np.concatenate(pieces) if pieces else np.zeros((0, 4, 3))


def _batches(tree: shapely.STRtree, areas: NDArray, rows: Ints, within_m: float) -> Iterator[tuple[Ints, Ints]]:
    """Yield pairs of indices of areas at most `within_m` [m] apart: one of `rows`, one of the tree, batch by batch."""
    for first in range(0, len(rows), BATCH):
        some = rows[first : first + BATCH]
        one, other = tree.query(areas[some], predicate="dwithin", distance=within_m)
        yield some[one], other


def _find_joined(areas: NDArray, low: Array, high: Array, crossing: Mask) -> Mask:
    """Extend the mask `crossing` (N,) to all pieces of road that are connected with one in it, directly or not.

    Connected pieces are at most `JOINT_M` apart in plan and differ by less than `BRIDGE_M` in height; `low` and `high`
    (N,) are the heights of their lowest and highest corners [m].
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
    """Group a road's pieces into bridges; `over` and `near` (K - 1,) mark the pieces of decks and those near decks."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], over, [False]))))
    decks = tuple(slice(int(first), int(last) + 1) for first, last in edges.reshape(-1, 2))
    return Spans(decks, np.concatenate((near, [False])) | np.concatenate(([False], near)))


HIGHEST_M = 10_000.0  # largest height of a surface, above or below 0
STEP_M = 1.0  # distance of two cross-sections that are sampled; those that are needed are kept
TOLERANCE_M = 0.003  # largest distance of the surface from a cross-section that is left out
TWIST_M = 0.008  # largest distance of the surface from the triangles between two cross-sections
NARROW_M = 0.1  # width up to which a road is too narrow for a deck
STRAY_M = 0.02  # largest distance of the terrain from a cross-section, in a map with bridges
BEND_SHARE = 0.1  # share of an error in plan that counts as an error in height
ASIDE_M = (SIDEWALK_M, 6.0)  # distances beyond the outermost lanes at which the ground has still their height
FINE_M = 2.0  # distance of points across a road near a bridge, so that the ground at its side begins at its edge
MOST_FILLED = 50  # largest number of points between two borders of lanes, however wide a lane is
CELL_M = 0.5  # side of a square cell whose points are merged into one
FAR_M = 400.0  # distance from the outermost points to the edge of the terrain


@dataclass(frozen=True)
class Heights:
    """The points of a map's terrain and of the decks of its bridges, in the map's frame."""

    points: Array  # (N, 3) [m]; empty where the map is level at height 0
    decks: tuple[tuple[Array, ...], ...]  # of each deck, its cross-sections (T, 3) along s, from right to left [m]


def sample_heights(root: ElementTree.Element, origin: Path) -> Heights:
    """Sample the surface of the map below `root`, which keeps to `standard`.

    Raises `InputError` naming `origin` where a road reaches beyond `FARTHEST_M` in plan or `HIGHEST_M` in height.
    """
    roads = [Road(row) for row in root.iterfind("road")]
    if all(road.is_level for road in roads):
        return Heights(np.zeros((0, 3)), ())
    with np.errstate(all="ignore"):  # numbers that overflow are refused below
        strips = [_cross_sections(road) for road in roads]
    for road, strips_of_road in zip(roads, strips):
        if not all((np.abs(p) <= (FARTHEST_M, FARTHEST_M, HIGHEST_M)).all() for strip in strips_of_road for p in strip):
            far = f"{FARTHEST_M / 1000:g} km, or {HIGHEST_M:g} m in height"
            raise InputError(f"{origin}: road {shorten(road.id)} reaches beyond {far}")
    edges = [
        Borders(*(np.concatenate([strip.inner[row] for strip in strips_of_road]) for row in (0, -1)))
        for strips_of_road in strips
    ]
    spans = find_bridges(edges)
    bare = not any(lane.get("type") in WALKED for lane in root.iter("lane"))
    kinds = {name: road.kind for name, road in describe_map(root).roads.items()}
    decks = [
        deck
        for road, strips_of_road, span in zip(roads, strips, spans)
        for deck in _list_decks(strips_of_road, span, widened=bare and kinds[road.id] not in OPEN_ROADS)
    ]
    points = _sample_terrain(strips, spans)
    while decks:
        relief = Relief(points)  # its triangles may cut across a road with few points at its sides
        strays = [_find_strays(strips_of_road, span, relief) for strips_of_road, span in zip(strips, spans)]
        if not any(stray.any() for stray in strays):
            break
        spans = [span._replace(near=span.near | stray) for span, stray in zip(spans, strays)]
        points = _sample_terrain(strips, spans)
    return Heights(points, tuple(decks))


class Strip(NamedTuple):
    """The K cross-sections of a lane section, in the map's frame."""

    inner: Array  # (T, K, 3) points at the borders of the lanes, from right to left [m]
    outer: Array  # (2 len(ASIDE_M), K, 3) points at the sides of the road: right, then left [m]


def _cross_sections(road: Road) -> list[Strip]:
    """Compute the cross-sections of a road, lane section by lane section."""
    count = max(int(np.ceil(road.length / STEP_M)), 1)
    stations = np.unique(np.clip([*np.linspace(0.0, road.length, count + 1), *road.stations], 0.0, road.length))
    out = []
    for s, borders in road.sections(stations):
        t = np.stack([*borders.values(), np.zeros(len(s))])  # (lanes and the reference line, K)
        t = t if road.is_tilted_across else np.stack((t.min(axis=0), np.zeros(len(s)), t.max(axis=0)))
        t = np.sort(t, axis=0)
        points = road.point(np.tile(s, len(t)), t.ravel()).reshape(*t.shape, 3)
        outer = []
        for side, edge in ((-1, t[0]), (1, t[-1])):
            for beyond_m in ASIDE_M:
                aside = road.point(s, edge + side * beyond_m)
                aside[:, 2] = road.height(s, edge)
                outer.append(aside)
        out.append(Strip(points, np.stack(outer)))
    return out


def _list_decks(strips: list[Strip], spans: Spans, *, widened: bool) -> list[tuple[Array, ...]]:
    """List the decks of a road, each as its cross-sections (T, 3) [m], `widened` by a sidewalk on both sides.

    Decks no wider than `NARROW_M` are left out.
    """
    sides = (slice(0, 1), slice(len(ASIDE_M), len(ASIDE_M) + 1)) if widened else (slice(0), slice(0))
    whole = [np.concatenate((strip.outer[sides[0]], strip.inner, strip.outer[sides[1]])).round(4) for strip in strips]
    sections = [points[:, i] for points in whole for i in range(points.shape[1])]
    width = np.concatenate([np.ptp(strip.inner[..., :2], axis=0).max(axis=1) for strip in strips])
    return [tuple(sections[deck]) for deck in spans.decks if (width[deck] > NARROW_M).any()]


def _find_strays(strips: list[Strip], spans: Spans, relief: Relief) -> Mask:
    """Find the cross-sections (K,) of a road from which the terrain differs by more than `STRAY_M`.

    Those on decks are left out, and so are those that the ground keeps already.
    """
    errors = [
        np.abs(relief.heights(*np.moveaxis(s.inner[..., :2], 2, 0)) - s.inner[..., 2]).max(axis=0) for s in strips
    ]
    return (np.concatenate(errors) > STRAY_M) & ~_find_raised(spans) & ~spans.near


def _find_raised(spans: Spans) -> Mask:
    """Find the cross-sections (K,) of a road that are on decks alone.

    Where a deck ends within the road, its last cross-section is also part of the ground.
    """
    raised = np.zeros(len(spans.near), np.bool_)
    for deck in spans.decks:
        raised[deck.start + (deck.start > 0) : deck.stop - (deck.stop < len(raised))] = True
    return raised


def _sample_terrain(strips: list[list[Strip]], spans: list[Spans]) -> Array:
    """Compute the points (N, 3) [m] of the terrain of all roads, and those of a frame around them."""
    grounds = [_sample_ground(strips_of_road, span) for strips_of_road, span in zip(strips, spans)]
    surface, aside = (np.concatenate([ground[i] for ground in grounds]) for i in (0, 1))
    distance, _ = KDTree(surface[:, :2]).query(aside[:, :2])
    room = np.minimum(np.array(ASIDE_M) - 0.1, CLEAR_M)
    aside = aside[distance > np.tile(room, len(aside) // len(room))]
    merged = _merge(np.concatenate((surface, aside)))
    return np.concatenate((merged, surround_terrain(merged))).round(4)


def _sample_ground(strips: list[Strip], spans: Spans) -> tuple[Array, Array]:
    """Return the points (N, 3) of a road's surface outside its bridges and those (M, 3) at its sides [m].

    The M points are in the order of `ASIDE_M`, over and over.
    """
    raised = _find_raised(spans)
    inner, outer, first = [np.zeros((0, 3))], [np.zeros((0, 3))], 0
    for strip in strips:
        rows = np.arange(first, first + strip.inner.shape[1])
        first += len(rows)
        for part in np.split(rows, np.flatnonzero(np.diff(raised[rows])) + 1):
            if not raised[part[0]]:
                local = part - rows[0]
                kept = local[_find_needed(strip.inner[:, local], spans.near[part])]
                inner.append(strip.inner[:, kept].reshape(-1, 3))
                inner.append(_fill_across(strip.inner[:, local[spans.near[part]]]))
                outer.append(strip.outer[:, kept].reshape(2, len(ASIDE_M), -1, 3).swapaxes(1, 2).reshape(-1, 3))
    return np.concatenate(inner), np.concatenate(outer)


def _fill_across(points: Array) -> Array:
    """Interpolate points (N, 3) [m] between neighbours of each column of points (T, K, 3), at most `FINE_M` apart.

    Between two of them there are at most `MOST_FILLED`.
    """
    out = [np.zeros((0, 3))]
    for one, other in pairwise(points):
        count = min(int(np.ceil(np.linalg.norm(other - one, axis=1).max(initial=0.0) / FINE_M)), MOST_FILLED + 1)
        out += [one + share * (other - one) for share in np.linspace(0.0, 1.0, count + 1)[1:-1]]
    return np.concatenate(out)


def _find_needed(points: Array, fixed: Mask) -> Ints:
    """Select the columns of points (T, K, 3) [m] that keep the others within `TOLERANCE_M` (Douglas-Peucker).

    Others are interpolated linearly between the selected columns. Rows are in the order of t. Errors in height count in
    full, errors in plan in proportion to the tilt of the cross-section, at least by `BEND_SHARE`. The columns `fixed`
    (K,) are always selected.
    """
    across = points[-1] - points[0]
    tilt = np.abs(across[:, 2]) / np.maximum(np.hypot(across[:, 0], across[:, 1]), 0.1)
    weight = np.array([1.0, 1.0, 0.0]) * max(BEND_SHARE, float(np.nan_to_num(tilt.max()))) + (0.0, 0.0, 1.0)
    kept = {0, points.shape[1] - 1, *np.flatnonzero(fixed).tolist()}
    waiting = list(pairwise(sorted(kept)))
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        share = (np.arange(first + 1, last) - first) / (last - first)
        chord = points[:, first, None] + share[:, None] * (points[:, last] - points[:, first])[:, None]
        error = np.abs((points[:, first + 1 : last] - chord) * weight).max(axis=(0, 2))
        worst = int(error.argmax())
        fall = points[-1, (first, last), 2] - points[0, (first, last), 2]  # across, at both ends
        if abs(fall[1] - fall[0]) / 4 > TWIST_M:  # two triangles differ so much from a twisted patch
            worst = (last - first) // 2 - 1
            error[worst] = np.inf
        if error[worst] > TOLERANCE_M:
            kept.add(first + 1 + worst)
            waiting += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return np.array(sorted(kept))


def _merge(points: Array) -> Array:
    """Average the points (N, 3) [m] in every square cell of side `CELL_M`: one point a cell, (M, 3)."""
    cells = np.unique(np.floor(points[:, :2] / CELL_M), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(cells)
    return np.stack([np.bincount(cells, column) / count for column in points.T], axis=1)


def surround_terrain(points: Array, far_m: float = FAR_M) -> Array:
    """Place points (K, 3) on a frame `far_m` [m] around `points` (N, 3) [m], at the height of the nearest of them."""
    low, high = points[:, :2].min(axis=0) - far_m, points[:, :2].max(axis=0) + far_m
    share = np.linspace(0.0, 1.0, 9)
    x, y = low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])
    sides = [np.stack(np.broadcast_arrays(x, edge), axis=1) for edge in (low[1], high[1])]
    sides += [np.stack(np.broadcast_arrays(edge, y[1:-1]), axis=1) for edge in (low[0], high[0])]
    frame = np.concatenate(sides)
    nearest = KDTree(points[:, :2]).query(frame)[1]
    return np.column_stack((frame, points[nearest, 2]))
