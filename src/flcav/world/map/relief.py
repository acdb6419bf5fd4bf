"""Relief of a town: the height of the ground, linear over the triangles of a Delaunay triangulation (TIN), and bridges.

A bridge's deck is a separate surface above the ground.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Ints, Ints32
from flcav.config import InputError
from flcav.machine.compiled import compiled
from flcav.storage.files import read_parquet

PLACE = ("deck", "section")  # columns of a town's heights with bridges
AXLE_SHARE, TRACK_SHARE = 0.3, 0.4  # distances of the wheels from the centre, over a vehicle's length and width
FARTHEST_M = 1e8  # greatest coordinate
BESIDE_M = 5.0  # distance from a deck within which an approximately known place may be on it
NOISE_M = 0.1  # depth below the surface of a deck within which a point counts as on it


class Relief:
    """The heights of a town's ground, and the decks of its bridges; immutable."""

    def __init__(self, points: Array, decks: "Sequence[Deck]" = ()) -> None:
        """Set the points (N, 3) of the ground, world frame [m]. Raises `ValueError` where they span no area."""
        self.points = points
        self.decks = tuple(decks)
        if len(points) < 3 or not (np.abs(points) <= FARTHEST_M).all():
            raise ValueError("a relief needs three points or more, with finite coordinates")
        try:
            self.triangles  # noqa: B018 - so that points without an area are refused here
        except QhullError:
            raise ValueError("the points of a relief span no area") from None

    def __getstate__(self) -> dict[str, object]:
        return {"points": self.points, "decks": self.decks}

    @cached_property
    def triangles(self) -> Ints32:
        """The triangles (F, 3), indices of `points`, counter-clockwise."""
        return self._tin.simplices

    @cached_property
    def tree(self) -> shapely.STRtree:
        """A spatial index of the triangles in plan."""
        return shapely.STRtree([shapely.Polygon(corners) for corners in self.points[self.triangles, :2]])

    @cached_property
    def area(self) -> BaseGeometry:
        """The area of the triangles in plan [m]."""
        return shapely.MultiPoint(self.points[:, :2]).convex_hull

    def heights(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Return the height (...) [m] of the ground at `x`, `y` (...) [m]; constant beyond the bounds; NaN at NaN."""
        low, high = self.points[:, :2].min(axis=0), self.points[:, :2].max(axis=0)
        inset = 1e-6 * (high - low)
        at = np.clip(np.stack(np.broadcast_arrays(x, y), axis=-1).astype(np.float64), low + inset, high - inset)
        z = _interpolate(at.reshape(-1, 2), self.points, self._tin.simplices, self._tin.neighbors)
        return z.reshape(at.shape[:-1])

    def sole_heights(self, x: Array, y: Array) -> Array:
        """Return the height (N,) [m] of the ground at `x`, `y` (N,) [m]; NaN at bridges, where there are two levels."""
        out = self.heights(x, y)
        for deck in self.decks:
            out[shapely.dwithin(deck.outline, shapely.points(x, y), BESIDE_M)] = np.nan
        return out

    def above(self, points: Array) -> Array:
        """Return the height (N,) [m] of points (N, 3), world frame [m], above the ground or a deck below them."""
        x, y, z = points.T
        foot = self.heights(x, y)
        for deck in self.decks:
            inside = np.flatnonzero(shapely.contains_xy(deck.outline, x, y))
            top = deck.surface.heights(x[inside], y[inside])
            foot[inside] = np.where(top <= z[inside] + NOISE_M, np.maximum(top, foot[inside]), foot[inside])
        return z - foot

    def table(self) -> pa.Table:
        """Return the points as a table with the columns x, y, z [m].

        With bridges it also has `deck` and `section`, the indices of a point's deck and cross-section; -1: ground.
        """
        if not self.decks:
            return pa.table(dict(zip("xyz", self.points.T)))
        rows = [np.column_stack((self.points, np.full((len(self.points), 2), -1.0)))]
        for number, deck in enumerate(self.decks):
            rows += [
                np.column_stack((section, np.broadcast_to((number, i), (len(section), 2))))
                for i, section in enumerate(deck.sections)
            ]
        x, y, z, number, section = np.concatenate(rows).T
        places = {"deck": number.astype(np.int32), "section": section.astype(np.int32)}
        return pa.table({"x": x, "y": y, "z": z} | places)

    def save(self, path: Path) -> None:
        """Write the table as Parquet."""
        pq.write_table(self.table(), path, compression="zstd")

    @classmethod
    def load(cls, path: Path) -> "Relief":
        """Load the relief that `save` wrote. Raises `InputError` where the file is damaged."""
        table = read_parquet(path)
        names = table.column_names
        if names not in ([*"xyz"], [*"xyz", *PLACE]) or any(column.null_count for column in table.columns):
            raise InputError(
                f"{path}: not the heights of a town (its columns must be x, y, z, or these and deck, section)"
            )
        try:
            points = np.stack([table[name].to_numpy().astype(np.float64) for name in "xyz"], axis=1)
            if names == [*"xyz"]:
                return cls(points)
            number, section = (table[name].to_numpy().astype(np.int64) for name in PLACE)
            decks = [_split_sections(points[number == i], section[number == i]) for i in np.unique(number[number >= 0])]
            return cls(points[number < 0], [Deck(sections) for sections in decks])
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: not the heights of a town ({error})") from None

    @cached_property
    def _tin(self) -> Delaunay:
        return Delaunay(self.points[:, :2])


class Deck:
    """The deck of a bridge: the surface of a road where it passes above another one; immutable."""

    def __init__(self, sections: Sequence[Array]) -> None:
        """Set its cross-sections (T, 3) along the road, from right to left, world frame [m].

        Raises `ValueError` where they span no area.
        """
        self.sections = tuple(sections)
        self.surface = Relief(np.unique(np.concatenate(self.sections), axis=0))
        if len(self.sections) < 2 or not self.outline.area > 0:
            raise ValueError("a deck needs two cross-sections or more that span an area")

    def __getstate__(self) -> dict[str, object]:
        return {"sections": self.sections, "surface": self.surface}

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """The right and the left edge, (K, 3) and (K, 3) [m]."""
        return np.stack([s[0] for s in self.sections]), np.stack([s[-1] for s in self.sections])

    @cached_property
    def outline(self) -> BaseGeometry:
        """The area of the deck in plan [m]."""
        right, left = self.sides
        area = shapely.make_valid(shapely.Polygon(np.concatenate((right, left[::-1]))[:, :2]))
        shapely.prepare(area)
        return area


def find_tilts(
    heights: Callable[[Array, Array], Array], x: Array, y: Array, yaw: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Return height [m], pitch and roll [rad] of bodies (...) that stand on four wheels at `x`, `y` [m], world frame.

    `heights` gives the height of the ground [m]; `yaw` is in [rad]; `size` (..., 3) is length, width, height [m]; the
    wheels are at `AXLE_SHARE` and `TRACK_SHARE` of it from the centre. A positive pitch turns the nose down, a positive
    roll lifts the left side, as in `geometry.pose`.
    """
    along, aside = AXLE_SHARE * size[..., 0], TRACK_SHARE * size[..., 1]
    cos, sin = np.cos(yaw), np.sin(yaw)

    def wheel(ahead: int, left: int) -> Array:
        return heights(x + ahead * along * cos - left * aside * sin, y + ahead * along * sin + left * aside * cos)

    (front_left, front_right), (rear_left, rear_right) = ((wheel(a, 1), wheel(a, -1)) for a in (1, -1))
    rise = (front_left + front_right - rear_left - rear_right) / 2
    bank = (front_left + rear_left - front_right - rear_right) / 2
    height = (front_left + front_right + rear_left + rear_right) / 4
    pitch = -np.arctan2(rise, 2 * along)
    return height, pitch, np.arctan2(bank * np.cos(pitch), 2 * aside)


def _split_sections(points: Array, section: Ints) -> list[Array]:
    """Split points (N, 3) [m] into cross-sections by their indices (N,), in the order of the rows."""
    return np.split(points, np.flatnonzero(np.diff(section)) + 1)


@compiled
def _interpolate(at, points, triangles, neighbours):
    """Interpolate heights (N,) [m] at places (N, 2) [m]; a triangle is found by walking from that of the last place.

    Walking crosses the edge that the place is farthest beyond, until it is inside; consecutive places are mostly near.
    """
    out = np.empty(len(at))
    here = 0
    for i in range(len(at)):
        x, y = at[i]
        out[i] = np.nan
        if not np.isfinite(x + y):
            continue
        for _ in range(len(triangles)):
            a, b, c = triangles[here]
            ax, ay, bx, by = points[a, 0] - x, points[a, 1] - y, points[b, 0] - x, points[b, 1] - y
            cx, cy = points[c, 0] - x, points[c, 1] - y
            towards_a, towards_b, towards_c = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
            least = min(towards_a, towards_b, towards_c)
            opposite = 0 if least == towards_a else 1 if least == towards_b else 2
            if least >= 0 or neighbours[here, opposite] < 0:
                weight_a, weight_b, weight_c = max(towards_a, 0.0), max(towards_b, 0.0), max(towards_c, 0.0)
                total = max(weight_a + weight_b + weight_c, 1e-300)
                out[i] = (weight_a * points[a, 2] + weight_b * points[b, 2] + weight_c * points[c, 2]) / total
                break
            here = neighbours[here, opposite]
    return out
