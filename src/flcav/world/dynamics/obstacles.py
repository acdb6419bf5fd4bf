"""Static collision geometry of a town: the ground with bridges and kerbs, and obstacles as upright boxes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import Polygon

from flcav.arrays import Array, Ints, Mask
from flcav.geometry import heading_vectors
from flcav.world.dynamics.contacts import Footprints
from flcav.world.map.relief import find_tilts
from flcav.world.map.town import KERB_M, Town
from flcav.world.meshes.furniture import MAST_BEHIND_M
from flcav.world.snapshot import NOBODY, Actors

LAMP_M, POST_M, MAST_M = 0.08, 0.05, 0.09  # radius of the posts of lamps, of signs and signals, and of sensors
CLEARANCE_M = 0.15  # ground clearance: lower objects, such as debris, do not obstruct
BELOW_M = 1.0  # depth of obstacles below the ground at their centre, since it may slope


class Obstacles(NamedTuple):
    """The S obstacles of a town, with a spatial index."""

    boxes: Footprints  # S upright boxes, world frame
    name: tuple[str, ...]  # (S,) "kind:row", e.g. "building:3"
    tree: shapely.STRtree  # of the bounding rectangles in plan

    def near(self, low: Array, high: Array) -> Ints:
        """Return the rows (K,), ascending, of obstacles that may touch a rectangle from `low` to `high` (N, 2) [m]."""
        return np.unique(self.tree.query(shapely.box(*low.T, *high.T))[1])


def list_obstacles(town: Town, parked: Actors = NOBODY) -> Obstacles:
    """Return the obstacles of a town: buildings, tree trunks, clutter, posts, and the `parked` vehicles."""
    rows, name = [np.zeros((0, 6))], []
    for kind, part in _parts(town):
        rows.append(part)
        name += [f"{kind}:{row}" for row in range(len(part))]
    x, y, yaw, length, width, height = np.concatenate(rows).T
    ground = town.grounds(x, y)
    standing = Footprints(
        np.column_stack((x, y, yaw)),
        np.column_stack((length, width)) / 2,
        np.column_stack((ground - BELOW_M, ground + height)),
    )
    boxes = join_footprints(standing, outline_actors(parked))
    low, high = corners(boxes)
    return Obstacles(boxes, (*name, *parked.name), shapely.STRtree(shapely.box(*low.T, *high.T)))


def outline_actors(actors: Actors) -> Footprints:
    """Return the upright boxes of actors, world frame [m]; those of vehicles and people begin at `CLEARANCE_M`."""
    z = actors.position[:, 2]
    clear = np.where(np.array(actors.category, np.str_) == "prop", 0.0, CLEARANCE_M)
    return Footprints(actors.places, actors.size[:, :2] / 2, np.column_stack((z + clear, z + actors.size[:, 2])))


def join_footprints(*parts: Footprints) -> Footprints:
    """Concatenate footprints, in order."""
    return Footprints(*(np.concatenate(arrays) for arrays in zip(*parts)))


def corners(boxes: Footprints) -> tuple[Array, Array]:
    """Return the bounding rectangles of footprints: lowest and highest x, y, (N, 2) and (N, 2) [m], world frame."""
    cos, sin = np.abs(heading_vectors(boxes.place[:, 2])).T
    length, width = boxes.half.T
    reach = np.column_stack((length * cos + width * sin, length * sin + width * cos))
    return boxes.place[:, :2] - reach, boxes.place[:, :2] + reach


def _parts(town: Town) -> Iterator[tuple[str, Array]]:
    """Yield the kind and the rows x, y [m], yaw [rad], length, width, height [m] (K, 6) of all obstacles."""
    yield "building", town.buildings
    x, y, height, _ = town.trees.T
    yield "tree", _posts(np.column_stack((x, y)), 0.05 + 0.018 * height, height)
    yield "clutter", np.concatenate([np.zeros((0, 6)), *(rows for _, rows in town.clutter)])
    yield "post", _posts(town.posts[:, :2], POST_M, town.posts[:, 2])
    yield "lamp", _posts(town.lamps[:, :2], LAMP_M, town.lamps[:, 2])
    yield "sign", _posts(town.signs.position[:, :2], POST_M, 2.0)
    masts = town.poles.position[:, :2] - MAST_BEHIND_M * heading_vectors(town.poles.yaw)
    yield "pole", _posts(masts, MAST_M, town.poles.position[:, 2])
    yield "signal", _posts(town.signals.foot, POST_M, 3.0)


def _posts(foot: Array, radius: Array | float, height: Array | float) -> Array:
    """Return posts at `foot` (K, 2) [m] with this radius and height [m] as rows x, y, yaw, length, width, height."""
    level = np.zeros(len(foot))
    return np.column_stack((foot, level, 2 * radius + level, 2 * radius + level, height + level))


EDGE_M = 0.05  # margin around a deck within which a point counts as on it


class TownGround:
    """The ground of a town with its bridges and kerbs."""

    def __init__(self, town: Town) -> None:
        """Prepare the sidewalks and decks for queries."""
        self._town = town
        self._pavement = shapely.union_all([Polygon(outline) for outline in town.sidewalks])
        shapely.prepare(self._pavement)
        decks = () if town.relief is None else town.relief.decks
        self._decks = [(deck, deck.outline.buffer(EDGE_M)) for deck in decks]
        for _, area in self._decks:
            shapely.prepare(area)

    def heights(self, x: Array, y: Array, z: Array) -> Array:
        """Return the height (N,) [m] at x, y (N,) [m] of the ground, or of a deck if that is nearer to `z` (N,) [m].

        With a `z` of NaN it is that of the ground.
        """
        ground = self._town.grounds(x, y)
        for deck, area in self._decks:
            inside = np.flatnonzero(shapely.contains_xy(area, x, y))
            top = deck.surface.heights(x[inside], y[inside])
            ground[inside] = np.where(np.abs(top - z[inside]) < np.abs(ground[inside] - z[inside]), top, ground[inside])
        return ground

    def stand(self, position: Array, yaw: Array, size: Array, upright: Mask) -> tuple[Array, Array]:
        """Return height (N,) [m], pitch and roll (N, 2) [rad] of bodies on the ground, world frame.

        The bodies have `size` (N, 3) [m], `position` (N, 3) [m] and `yaw` (N,) [rad]. Whether a body is on a bridge or
        below it follows from its height; NaN: below. Bodies that are `upright` (N,) do not tilt, and step onto kerbs.
        """
        x, y, z = position.T
        height, tilt = np.zeros(len(x)), np.zeros((len(x), 2))
        if self._town.relief is not None:
            height, pitch, roll = find_tilts(lambda a, b: self.heights(a, b, z), x, y, yaw, size)
            tilt = np.where(upright[:, None], 0.0, np.column_stack((pitch, roll)))
            height = np.where(upright, self.heights(x, y, z), height)
        feet = np.flatnonzero(upright)
        height[feet] += KERB_M * shapely.contains_xy(self._pavement, x[feet], y[feet])
        return height, tilt
