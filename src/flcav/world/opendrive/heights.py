"""Sampling of the surface of an OpenDRIVE map as points of a terrain (`flcav.world.map.relief`)."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from flcav.config import InputError, shorten
from flcav.world.opendrive.road_surface import Road
from flcav.world.opendrive.standard import FARTHEST_M

Array = NDArray[np.float64]

HIGHEST_M = 10_000.0
STEP_M = 1.0  # between two cross-sections, of which those are kept that are needed
TOLERANCE_M = 0.003  # by which the surface may differ from a cross-section that is left out
TWIST_M = 0.008  # and by which it may leave the plane between two of them
BEND_SHARE = 0.1  # of an error in plan that counts as one of height
ASIDE_M = (2.0, 6.0)  # beyond the outermost lanes the ground goes on at their height
CLEAR_M = 4.0  # such points are left out within this distance of another road
BRIDGE_M = 2.5  # a road at least this far above another one passes over it
CELL_M = 0.5  # points of different roads in one cell are one
FAR_M = 400.0  # from the outermost points to the edge of the terrain


@dataclass(frozen=True)
class Heights:
    """The points of a map's terrain."""

    points: Array  # (N, 3) [m]; empty where the map is level at height 0
    bridges: int  # roads of which parts pass above another one; the terrain follows the lower


def sample_heights(root: ElementTree.Element, origin: Path) -> Heights:
    """Return points of the surface of the map below `root`, which keeps to `standard`.

    Raises `InputError` naming `origin` where the surface leaves the Earth.
    """
    roads = [Road(row) for row in root.iterfind("road")]
    if all(road.is_level for road in roads):
        return Heights(np.zeros((0, 3)), 0)
    with np.errstate(all="ignore"):  # numbers that overflow are refused below
        sections = [_cross_sections(road) for road in roads]
    for road, parts in zip(roads, sections):
        if not all((np.abs(points) <= (FARTHEST_M, FARTHEST_M, HIGHEST_M)).all() for points in parts):
            far = f"{FARTHEST_M / 1000:g} km, or {HIGHEST_M:g} m in height"
            raise InputError(f"{origin}: road {shorten(road.id)} reaches beyond {far}")
    surface = np.concatenate([inner for inner, _ in sections])
    aside = np.concatenate([outer for _, outer in sections])
    owner = np.repeat(np.arange(len(roads)), [len(inner) for inner, _ in sections])
    above = _find_above(surface, owner)
    bridges = len(np.unique(owner[above]))
    surface = surface[~above]
    distance, _ = KDTree(surface[:, :2]).query(aside[:, :2])
    room = np.minimum(np.array(ASIDE_M) - 0.1, CLEAR_M)
    aside = aside[distance > np.tile(room, len(aside) // len(room))]
    merged = _merge(np.concatenate((surface, aside)))
    return Heights(np.concatenate((merged, surround(merged))).round(4), bridges)


def _cross_sections(road: Road) -> tuple[Array, Array]:
    """Return the points (N, 3) of a road's surface at the borders of its lanes, and those (M, 3) beside it."""
    count = max(int(np.ceil(road.length / STEP_M)), 1)
    stations = np.unique(np.clip([*np.linspace(0.0, road.length, count + 1), *road.stations], 0.0, road.length))
    inner, outer = [], []
    for s, borders in road.sections(stations):
        t = np.stack([*borders.values(), np.zeros(len(s))])  # (lanes and the reference line, K)
        t = t if road.is_tilted_across else np.stack((t.min(axis=0), np.zeros(len(s)), t.max(axis=0)))
        t = np.sort(t, axis=0)
        points = road.point(np.tile(s, len(t)), t.ravel()).reshape(*t.shape, 3)
        kept = _find_needed(points)
        s, t = s[kept], t[:, kept]
        inner.append(points[:, kept].reshape(-1, 3))
        for side, edge in ((-1, t.min(axis=0)), (1, t.max(axis=0))):
            beyond = edge[:, None] + side * np.array(ASIDE_M)
            points = road.point(np.repeat(s, len(ASIDE_M)), beyond.ravel())
            points[:, 2] = np.repeat(road.height(s, edge), len(ASIDE_M))
            outer.append(points)
    return np.concatenate(inner), np.concatenate(outer)


def _find_needed(points: Array) -> NDArray[np.int64]:
    """Return the columns of points (T, K, 3) between which the others are linear, to `TOLERANCE_M` (Douglas-Peucker).

    Rows are in the order of t. Height errors count in full; errors in plan as far as the cross-section is tilted, and
    at least to `BEND_SHARE`.
    """
    across = points[-1] - points[0]
    tilt = np.abs(across[:, 2]) / np.maximum(np.hypot(across[:, 0], across[:, 1]), 0.1)
    weight = np.array([1.0, 1.0, 0.0]) * max(BEND_SHARE, float(np.nan_to_num(tilt.max()))) + (0.0, 0.0, 1.0)
    kept, waiting = {0, points.shape[1] - 1}, [(0, points.shape[1] - 1)]
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


def _find_above(points: Array, owner: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (N,) whether a point lies `BRIDGE_M` or more above a point of another road within `CLEAR_M`."""
    if np.ptp(points[:, 2]) < BRIDGE_M:
        return np.zeros(len(points), np.bool_)
    one, other = KDTree(points[:, :2]).query_pairs(CLEAR_M, output_type="ndarray").T
    rise = points[one, 2] - points[other, 2]
    crossing = (owner[one] != owner[other]) & (np.abs(rise) >= BRIDGE_M)
    out = np.zeros(len(points), np.bool_)
    out[np.where(rise > 0, one, other)[crossing]] = True
    return out


def _merge(points: Array) -> Array:
    """Return points (M, 3) of which no two lie in one cell: the means of those that did."""
    cells = np.unique(np.floor(points[:, :2] / CELL_M), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(cells)
    return np.stack([np.bincount(cells, column) / count for column in points.T], axis=1)


def surround(points: Array, far_m: float = FAR_M) -> Array:
    """Return points (K, 3) on a frame `far_m` around, at the height of the nearest point."""
    low, high = points[:, :2].min(axis=0) - far_m, points[:, :2].max(axis=0) + far_m
    share = np.linspace(0.0, 1.0, 9)
    x, y = low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])
    sides = [np.stack(np.broadcast_arrays(x, edge), axis=1) for edge in (low[1], high[1])]
    sides += [np.stack(np.broadcast_arrays(edge, y[1:-1]), axis=1) for edge in (low[0], high[0])]
    frame = np.concatenate(sides)
    nearest = KDTree(points[:, :2]).query(frame)[1]
    return np.column_stack((frame, points[nearest, 2]))
