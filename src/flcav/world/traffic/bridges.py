"""Assignment of actors to the levels of bridges: on the deck, or on the street below it.

SUMO's net has no heights. An actor within the outline of a deck is on it if, over its whole passage, the lanes over the
deck are nearer and better aligned with the actor's heading than those below.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Mask
from flcav.geometry import heading_vectors
from flcav.world.map.relief import Deck, Relief
from flcav.world.map.roads import RoadNet, read_net

REACH_M = 15.0  # half a long vehicle, and the distance of 0.3 s: closer to a deck, an actor is on it or below it
ALONG = np.cos(np.pi / 4)  # least alignment of lanes over a deck with its direction
TURNED_M = 6.0  # distance that is weighted like a right angle between an actor and a lane
BATCH = 1000  # actors that are compared with all lanes at a time
BESIDE_SHARE = 1e-3  # weight of instants next to a deck, relative to those within its outline
EDGE_M = 0.05  # margin around a deck within which a point counts as on it


class Segments(NamedTuple):
    """S pieces of lanes in plan, world frame."""

    start: Array  # (S, 2) start [m]
    along: Array  # (S, 2) vector from start to end [m]


def find_footing(relief: Relief, net: Path, centre: Array, yaw: Array) -> Callable[[Array, Array], Array]:
    """Return a function from x, y (T, A) [m] to the heights (T, A) [m] of the actors' surfaces: ground or deck.

    The actors are at `centre` (T, A, 2) [m] with `yaw` (T, A) [rad], world frame, NaN where absent; `net` is the file
    of the road net.
    """
    if not relief.decks:
        return relief.heights
    streets = read_net(net)
    on = [(deck, _find_on(deck, streets, centre, yaw)) for deck in relief.decks]

    def heights(x: Array, y: Array) -> Array:
        out = relief.heights(x, y)
        for deck, rows in on:
            area = deck.outline.buffer(EDGE_M)
            shapely.prepare(area)
            at = np.nonzero(rows)
            on_deck = np.maximum(out[at], deck.surface.heights(x[at], y[at]))
            out[at] = np.where(shapely.contains_xy(area, x[at], y[at]), on_deck, out[at])
        return out

    return heights


def _find_on(deck: Deck, net: RoadNet, centre: Array, yaw: Array) -> Mask:
    """Return (T, A) whether actors are on a deck or approach it; constant while an actor stays near the deck."""
    zone = deck.outline.buffer(REACH_M)
    shapely.prepare(zone)
    out = shapely.contains_xy(zone, centre[..., 0], centre[..., 1])
    over, below = split_lanes(deck, net, zone)
    if not len(over.start):
        return np.zeros_like(out)
    place = centre[out]
    ahead = heading_vectors(yaw[out])
    worse = [
        _misfit(over, place[rows], ahead[rows]) - _misfit(below, place[rows], ahead[rows])
        for rows in np.split(np.arange(len(place)), np.arange(BATCH, len(place), BATCH))
    ]
    weight = np.where(shapely.contains_xy(deck.outline, *place.T), 1.0, BESIDE_SHARE)
    begins = np.ones(out.shape, np.bool_)
    begins[1:] = ~out[:-1] | (np.linalg.norm(np.diff(centre, axis=0), axis=2) > REACH_M)
    stay = (
        np.cumsum((begins & out).T).reshape(out.T.shape).T[out]
    )  # index of an uninterrupted stay of one actor near the deck
    out[out] = (np.bincount(stay, weight * np.concatenate(worse)) < 0)[stay]
    return out


def split_lanes(deck: Deck, net: RoadNet, zone: BaseGeometry) -> tuple[Segments, Segments]:
    """Split the lanes within `zone` into the pieces that lead over a deck, and those that do not.

    A lane over the deck is aligned with it, and does not cross its sides.
    """
    right, left = (side[:, :2] for side in deck.sides)
    middle = (right + left) / 2
    axis = np.gradient(middle, axis=0)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    sides = shapely.union_all([LineString(right), LineString(left)])
    over, below = [], []
    for edge in net.edges.values():
        for lane in edge.lanes:
            if lane.kind == "walkingarea" or len(lane.shape) < 2:
                continue
            for part in shapely.get_parts(LineString(lane.shape).intersection(zone)):
                if part.geom_type != "LineString":
                    continue
                points = shapely.get_coordinates(part)
                along = np.diff(points, axis=0)
                nearest = np.linalg.norm(points[:-1, None] + along[:, None] / 2 - middle, axis=2).argmin(axis=1)
                kept = np.abs((along * axis[nearest]).sum(axis=1)).sum() >= ALONG * np.linalg.norm(along, axis=1).sum()
                (over if kept and not part.intersects(sides) else below).append(Segments(points[:-1], along))
    return _join(over), _join(below)


def _join(parts: list[Segments]) -> Segments:
    empty = np.zeros((0, 2))
    return Segments(*(np.concatenate([empty, *rows]) for rows in (zip(*parts) if parts else ((), ()))))


def _misfit(lanes: Segments, place: Array, ahead: Array) -> Array:
    """Return (N,) [m] the combined distance in place and direction of actors from their best-fitting lanes.

    Actors are at `place` (N, 2) [m] with the unit headings `ahead` (N, 2).
    """
    if not len(lanes.start):
        return np.full(len(place), np.inf)
    length = np.maximum(np.linalg.norm(lanes.along, axis=1), 1e-9)
    towards = place[:, None] - lanes.start
    share = np.clip((towards * lanes.along).sum(axis=2) / length**2, 0.0, 1.0)
    away = np.linalg.norm(towards - share[..., None] * lanes.along, axis=2)
    cross = ahead[:, None, 0] * lanes.along[:, 1] - ahead[:, None, 1] * lanes.along[:, 0]
    return (away + TURNED_M * np.abs(cross) / length).min(axis=1)
