"""Procedural textures of asphalt, paving and grass, and anti-aliased road markings.

Markings are rectangles in a grid. A rectangle's coverage of a pixel's footprint is the product of the overlaps of two
intervals, along and across it: exact where the footprint is aligned with the rectangle, otherwise smooth and correct on
average. So lines fade with distance, without aliasing.
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.ops import substring

from flcav.arrays import Array, Array32, Ints32
from flcav.geometry import heading_vectors
from flcav.machine.compiled import inlined
from flcav.sensors.rendering.noise import fade, hash_pair, overlap, sample_noise
from flcav.world.map.layers import Arrow, ArrowKind, MapLayers, Marking, outline_arrow, outline_stripes

CELL_M = 1.0  # side of the cells of the grid
REACH_M = 0.3  # margin around a rectangle within which grid cells list it
STRIP_M = 0.06  # arrows are cut into strips of this length
COLOURS = {"white": (0.68, 0.68, 0.66), "yellow": (0.62, 0.42, 0.06)}

Rectangle = tuple[float, float, float, float, float, float]  # centre x, y, direction x, y, half length, half width
SLAB_M = 0.5  # side of a paving slab
JOINT_M = 0.012  # width of the joints between slabs


class Markings(NamedTuple):
    """Road markings as K rectangles, world frame, with a grid whose cells list those nearby."""

    rectangle: Array32  # (K, 6) see `Rectangle` [m]
    colour: Array32  # (K, 3) linear RGB
    worn: np.float32  # wear of the paint, 0 to 1
    corner: Array  # (2,) lowest x, y of the grid [m]
    first: Ints32  # (cells along x, cells along y + 1) start of a cell's list
    listed: Ints32  # lists of rows of `rectangle`, cell by cell


def build_markings(layers: MapLayers, worn: float = 0.0) -> Markings:
    """Return the lane lines, crossings and arrows of a map as rectangles, with the wear of their paint, 0 to 1."""
    pieces = [(piece, COLOURS.get(line.colour, COLOURS["white"])) for line in layers.markings for piece in _line(line)]
    white = COLOURS["white"]
    pieces += [(_box(stripe), white) for crossing in layers.crossings for stripe in outline_stripes(crossing)]
    pieces += [(strip, white) for arrow in layers.arrows for strip in _arrow(arrow)]
    rectangle = np.array([piece for piece, _ in pieces], np.float32).reshape(-1, 6)
    colour = np.array([colour for _, colour in pieces], np.float32).reshape(-1, 3)
    return Markings(rectangle, colour, np.float32(worn), *_grid(rectangle))


@inlined
def sample_paint(x, y, look_x, look_y, across, along, markings):
    """Return the painted share of a pixel's footprint around x, y [m], and the row of the rectangle that covers most.

    The footprint is `along` [m] long in the horizontal unit direction look_x, look_y, and `across` [m] wide.
    """
    i, j = int((x - markings.corner[0]) / CELL_M), int((y - markings.corner[1]) / CELL_M)
    if i < 0 or j < 0 or i >= markings.first.shape[0] or j >= markings.first.shape[1] - 1:
        return np.float32(0), 0
    total, most, which = np.float32(0), np.float32(0), 0
    for place in range(markings.first[i, j], markings.first[i, j + 1]):
        piece = markings.listed[place]
        box = markings.rectangle
        dx, dy, tx, ty = np.float32(x - box[piece, 0]), np.float32(y - box[piece, 1]), box[piece, 2], box[piece, 3]
        parallel = abs(look_x * tx + look_y * ty)
        crossed = abs(look_x * ty - look_y * tx)
        share = overlap(dx * tx + dy * ty, box[piece, 4], parallel * along + crossed * across)
        if share > 0:
            share *= overlap(dy * tx - dx * ty, box[piece, 5], crossed * along + parallel * across)
            total += share
            if share > most:
                most, which = share, piece
    return min(total, np.float32(1)), which


def _line(marking: Marking) -> Iterator[Rectangle]:
    line = LineString(marking.line)
    stroke = marking.dash_m or line.length
    for start in np.arange(0.0, line.length - 1e-6, stroke + marking.gap_m if marking.dash_m else line.length):
        points = np.asarray(substring(line, start, min(start + stroke, line.length)).coords)
        for a, b in pairwise(points):
            length = float(np.hypot(*(b - a)))
            if length > 1e-6:
                x, y = (a + b) / 2
                yield x, y, (b[0] - a[0]) / length, (b[1] - a[1]) / length, length / 2, marking.width_m / 2


def _box(outline: Array) -> Rectangle:
    """Return the smallest rectangle around a polygon."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(Polygon(outline)))
    one, other = corners[1] - corners[0], corners[2] - corners[1]
    length, width = np.hypot(*one), np.hypot(*other)
    x, y = corners[:4].mean(axis=0)
    return x, y, one[0] / length, one[1] / length, length / 2, width / 2


def _arrow(arrow: Arrow) -> Iterator[Rectangle]:
    cos, sin = heading_vectors(arrow.yaw).tolist()
    for x, y, half_length, half_width in _strips(arrow.kind):
        yield arrow.x + cos * x - sin * y, arrow.y + sin * x + cos * y, cos, sin, half_length, half_width


@lru_cache(maxsize=16)
def _strips(kind: ArrowKind) -> tuple[tuple[float, float, float, float], ...]:
    """Return an arrow at the origin, pointing along x, as strips: centre x, y, half length, half width [m]."""
    shape = Polygon(outline_arrow(Arrow(kind, 0.0, 0.0, 0.0, "")))
    low_x, low_y, high_x, high_y = shape.bounds
    out = []
    for start in np.arange(low_x, high_x, STRIP_M):
        end = min(start + STRIP_M, high_x)
        middle = (start + end) / 2
        chord = shape.intersection(LineString([(middle, low_y - 1), (middle, high_y + 1)]))
        parts = getattr(chord, "geoms", [chord])
        out += [(middle, part.centroid.y, (end - start) / 2, part.length / 2) for part in parts if part.length > 0]
    return tuple(out)


def _grid(rectangle: Array32) -> tuple[Array, Ints32, Ints32]:
    """Return the `corner`, `first` and `listed` of the grid of `Markings`."""
    if not len(rectangle):
        return np.zeros(2), np.zeros((1, 2), np.int32), np.zeros(0, np.int32)
    x, y, tx, ty, length, width = rectangle.T.astype(np.float64)
    half_x, half_y = np.abs(tx) * length + np.abs(ty) * width, np.abs(ty) * length + np.abs(tx) * width
    corner = np.array([(x - half_x).min(), (y - half_y).min()]) - REACH_M
    cells = np.ceil((np.array([(x + half_x).max(), (y + half_y).max()]) + REACH_M - corner) / CELL_M).astype(int) + 1
    spread = np.stack((half_x, half_y), axis=1) + REACH_M
    low, high = ((rectangle[:, :2] + side * spread - corner) // CELL_M for side in (-1, 1))
    across = high - low + 1
    count = across.prod(axis=1).astype(np.int64)
    row = np.repeat(np.arange(len(rectangle)), count)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    i, j = (low[row].T + np.divmod(number, across[row, 1])).astype(np.int64)
    dx, dy = corner[0] + (i + 0.5) * CELL_M - x[row], corner[1] + (j + 0.5) * CELL_M - y[row]
    near = 0.71 * CELL_M + REACH_M
    within = np.abs(dx * tx[row] + dy * ty[row]) < length[row] + near
    within &= np.abs(dy * tx[row] - dx * ty[row]) < width[row] + near
    pairs = np.stack((i * cells[1] + j, row), axis=1)[within]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    starts = np.searchsorted(pairs[:, 0], np.arange(cells[0] * cells[1] + 1)).astype(np.int32)
    first = np.empty((cells[0], cells[1] + 1), np.int32)
    first[:, :-1] = starts[:-1].reshape(cells[0], cells[1])
    first[:, -1] = starts[cells[1] :: cells[1]]
    return corner, first, pairs[:, 1].astype(np.int32)


@inlined
def wear(x, y, worn, table):
    """Return the share of the paint that is left at x, y [m]: with `worn` 1 none on half of it, a third elsewhere."""
    lost = min(np.float32(0.35) + np.float32(1.3) * sample_noise(table, x * 0.6 + 13.0, y * 0.6), np.float32(1))
    return 1 - worn * lost


@inlined
def asphalt(x, y, footprint, table):
    """Return the brightness of asphalt at x, y [m], over its mean: grain, stains, repairs, sealed cracks."""
    broad = sample_noise(table, x * 0.9, y * 0.9)
    patch = sample_noise(table, x * 0.11 + 40.0, y * 0.11)
    tone = np.float32(0.68) + np.float32(0.30) * broad + np.float32(0.40) * patch
    middle = fade(np.float32(0.12), footprint)
    if middle > 0:
        tone += middle * np.float32(0.30) * (sample_noise(table, x * 9.0, y * 9.0) - np.float32(0.5))
        crack = abs(sample_noise(table, x * 0.55 + 90.0, y * 0.55 + 17.0) - np.float32(0.5))
        if crack < np.float32(0.006) and patch > np.float32(0.45):
            tone -= middle * np.float32(0.35)
    fine = fade(np.float32(0.022), footprint)
    if fine > 0:
        tone += fine * np.float32(0.55) * (sample_noise(table, x * 71.0, y * 71.0) - np.float32(0.5))
    return tone


@inlined
def paving(x, y, footprint, table):
    """Return the brightness of paving slabs at x, y [m], over their mean."""
    i, j = int(np.floor(x / SLAB_M)), int(np.floor(y / SLAB_M))
    tone = np.float32(0.86) + np.float32(0.24) * sample_noise(table, x * 0.5, y * 0.5)
    near = fade(np.float32(0.5), footprint)
    if near > 0:
        tone += near * np.float32(0.16) * (hash_pair(i, j) - np.float32(0.5))
        u, v = np.float32(x - (i + 0.5) * SLAB_M), np.float32(y - (j + 0.5) * SLAB_M)
        half = np.float32(SLAB_M / 2 - JOINT_M / 2)
        width = max(footprint, np.float32(0.004))
        inside = overlap(u, half, width) * overlap(v, half, width)
        tone *= 1 - near * np.float32(0.55) * (1 - inside)
        fine = fade(np.float32(0.03), footprint)
        if fine > 0:
            tone += fine * np.float32(0.16) * (sample_noise(table, x * 45.0, y * 45.0) - np.float32(0.5))
    return tone


@inlined
def grass(x, y, footprint, table):
    """Return the brightness of grass at x, y [m], over its mean, and its dryness, 0 to 1."""
    dry = sample_noise(table, x * 0.07, y * 0.07)
    tone = np.float32(0.55) + np.float32(0.6) * sample_noise(table, x * 0.8, y * 0.8)
    near = fade(np.float32(0.10), footprint)
    if near > 0:
        tone += near * np.float32(0.7) * (sample_noise(table, x * 16.0, y * 16.0) - np.float32(0.5))
    fine = fade(np.float32(0.02), footprint)
    if fine > 0:
        tone += fine * np.float32(0.7) * (sample_noise(table, x * 61.0, y * 43.0) - np.float32(0.5))
    return max(tone, np.float32(0.1)), dry
