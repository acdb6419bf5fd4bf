"""Procedural placement of what encloses plots (hedges, walls, fences) and of small objects at the kerb.

Both are clutter: rows (K, 6) x, y, yaw, length, width, height by kind, in the world frame [m, rad].
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flcav.world.map.parameters import CLUTTER
from flcav.world.map.street_furniture import KERBSIDE_M, Plot, Verge, draw, list_stations
from flcav.world.map.surfaces import make_footprint

Array = NDArray[np.float64]
Clutter = tuple[tuple[str, Array], ...]  # rows (K, 6) by kind
Piece = tuple[str, tuple[float, ...]]  # kind and row

PIECE_M = 4.0  # longest straight piece of a boundary
JOINT_M = 0.02  # between two pieces of a stretch


def place_boundaries(rows: list[Verge], plot: Plot, random: np.random.Generator) -> Clutter:
    """Return hedges, walls and fences along the verges whose streets have them.

    A stretch is of one kind, height and setback, and made of straight pieces; pieces without room are left out.
    """
    pieces: list[Piece] = []
    for verge in rows:
        street = verge.street
        along = draw(random, street.boundary_gap_m) if street.boundary else np.inf
        while along < verge.line.length:
            end = min(along + draw(random, street.boundary_length_m), verge.line.length)
            pieces += _stretch(verge, along, end, plot, random)
            along = end + max(draw(random, street.boundary_gap_m), 0.1)
    return _by_kind(pieces)


def _stretch(verge: Verge, start: float, end: float, plot: Plot, random: np.random.Generator) -> Iterator[Piece]:
    """Yield the pieces of one stretch of a boundary from `start` to `end` along the verge [m]."""
    kind = _choose(verge.street.boundary, random)
    _, width, height = np.array(CLUTTER[kind]) * random.uniform(*verge.street.clutter_size, size=3)
    setback = draw(random, verge.street.boundary_setback_m)
    edges = np.linspace(start, end, max(1, int(np.ceil((end - start) / PIECE_M))) + 1)
    for first, last in pairwise(edges.tolist()):
        x, y, yaw = verge.at((first + last) / 2, verge.half_width + setback + width / 2)
        if plot.build(make_footprint(x, y, yaw, last - first - JOINT_M, width), apart_m=0.0):
            yield kind, (x, y, yaw, last - first - JOINT_M, width, height * random.uniform(0.95, 1.05))


def place_kerbside(rows: list[Verge], random: np.random.Generator) -> Clutter:
    """Return the small objects at the kerb of the streets that have them."""
    pieces: list[Piece] = []
    for verge in (verge for verge in rows if verge.street.kerbside):
        for along in list_stations(verge, verge.street.kerbside_spacing_m, random):
            kind = _choose(verge.street.kerbside, random)
            length, width, height = np.array(CLUTTER[kind]) * random.uniform(*verge.street.clutter_size, size=3)
            x, y, yaw = verge.at(along, KERBSIDE_M - verge.half_width)
            pieces.append((kind, (x, y, yaw, length, width, height)))
    return _by_kind(pieces)


def join_clutter(*parts: Clutter) -> Clutter:
    """Return the clutter of all `parts`, by kind."""
    return _by_kind([(kind, tuple(row)) for part in parts for kind, rows in part for row in rows.tolist()])


def _choose(mix: dict[str, float], random: np.random.Generator) -> str:
    weights = np.array(list(mix.values()))
    return list(mix)[int(random.choice(len(mix), p=weights / weights.sum()))]


def _by_kind(pieces: list[Piece]) -> Clutter:
    kinds = sorted({kind for kind, _ in pieces})
    return tuple((kind, np.array([row for own, row in pieces if own == kind], np.float64)) for kind in kinds)
