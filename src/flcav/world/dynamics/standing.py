"""The ground that bodies stand on: their height, pitch and roll on a relief, on bridges and on kerbs."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from flcav.world.map.relief import find_tilts
from flcav.world.map.town import KERB_M, Town

Array = NDArray[np.float64]

EDGE_M = 0.05  # a point so far beside a deck still is on it


class Ground:
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
        """Return the height (N,) [m] of the ground, or of a deck there that is nearer to `z` (N,); NaN: the ground."""
        ground = self._town.grounds(x, y)
        for deck, area in self._decks:
            inside = np.flatnonzero(shapely.contains_xy(area, x, y))
            top = deck.surface.heights(x[inside], y[inside])
            ground[inside] = np.where(np.abs(top - z[inside]) < np.abs(ground[inside] - z[inside]), top, ground[inside])
        return ground

    def stand(self, position: Array, yaw: Array, size: Array, upright: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return height (N,) [m], pitch and roll (N, 2) [rad] of bodies of this `size` (N, 3) at `position` (N, 3) [m].

        On a bridge or below it is told by their height, NaN: below. Those who are `upright` (N,) do not tilt, and step
        onto kerbs.
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
