"""The surface of an OpenDRIVE road: elevation, superelevation, lateral shape and crossfall, and the borders of lanes.

Sources: OpenDRIVE 1.8, 10.5 (elevation, superelevation, shape) and 11 (lanes); 1.4, 5.3.5 (crossfall). A place on a
road is given by s [m] along its reference line and t [m] to the left of it.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator

import numpy as np

from flcav.arrays import Array
from flcav.world.opendrive.reference_line import ReferenceLine


class Cubics:
    """A piecewise cubic polynomial, by the distance from the start of the piece; 0 before the first piece."""

    def __init__(self, rows: Iterable[ElementTree.Element], start: str = "s") -> None:
        """Read the attribute `start` and the coefficients a to d of every row."""
        values = [[float(row.attrib[name]) for name in (start, *"abcd")] for row in rows]
        self._table = np.array(sorted(values, key=lambda row: row[0]), np.float64).reshape(-1, 5)

    def __bool__(self) -> bool:
        return bool(self._table[:, 1:].any())

    def at(self, s: Array) -> Array:
        """Evaluate the polynomial at `s` (N,)."""
        if not len(self._table):
            return np.zeros(len(s))
        number = np.searchsorted(self._table[:, 0], s, side="right") - 1
        start, a, b, c, d = self._table[np.maximum(number, 0)].T
        along = s - start
        return np.where(number < 0, 0.0, a + along * (b + along * (c + along * d)))


class Road:
    """One road: its reference line, its surface and its lanes."""

    def __init__(self, row: ElementTree.Element) -> None:
        """Read a <road> that keeps to `standard`."""
        self.id = row.get("id", "")
        self.line = ReferenceLine(row)
        self.length = self.line.length
        self._elevation = Cubics(row.iterfind("elevationProfile/elevation"))
        self._superelevation = Cubics(row.iterfind("lateralProfile/superelevation"))
        falls = [fall for fall in row.iterfind("lateralProfile/crossfall") if _is_cubic(fall)]
        self._left_fall, self._right_fall = (
            Cubics(fall for fall in falls if fall.get("side", "both") in ("both", side)) for side in ("left", "right")
        )
        shapes: dict[float, list[ElementTree.Element]] = {}
        for shape in row.iterfind("lateralProfile/shape"):
            shapes.setdefault(float(shape.attrib["s"]), []).append(shape)
        self._shapes = [(s, Cubics(shapes[s], "t")) for s in sorted(shapes)]
        self._offset = Cubics(row.iterfind("lanes/laneOffset"))
        self._sections = [Section(section) for section in row.iterfind("lanes/laneSection")]

    @property
    def is_level(self) -> bool:
        """Return whether the whole surface lies at height 0."""
        profiles = (self._elevation, self._superelevation, self._left_fall, self._right_fall)
        return not any(profiles) and not any(shape for _, shape in self._shapes)

    @property
    def is_tilted_across(self) -> bool:
        """Return whether cross-sections have superelevation or lateral shapes, which may change along the road."""
        return bool(self._superelevation) or any(shape for _, shape in self._shapes)

    @property
    def stations(self) -> list[float]:
        """Return the s [m] at which a lane section or a lateral shape begins."""
        return [*(section.s for section in self._sections), *(s for s, _ in self._shapes)]

    def point(self, s: Array, t: Array) -> Array:
        """Compute the points x, y, z (N, 3) [m] of the surface, in the map's frame, at `s` (N,) and `t` (N,) [m].

        A tilted cross-section is not shortened in plan: t is the horizontal distance.
        """
        x, y, heading = self.line.at(s).T
        return np.stack((x - t * np.sin(heading), y + t * np.cos(heading), self.height(s, t)), axis=1)

    def height(self, s: Array, t: Array) -> Array:
        """Compute the height (N,) [m] of the surface at `s` (N,) and `t` (N,) [m]."""
        fall = np.where(t > 0, self._left_fall.at(s), self._right_fall.at(s))
        tilted = t * np.tan(self._superelevation.at(s)) - np.abs(t) * np.tan(fall)
        return self._elevation.at(s) + tilted + self._shape(s, t)

    def sections(self, s: Array) -> Iterator[tuple[Array, dict[int, Array]]]:
        """Split `s` (N,) [m] by lane section; yield the s (K,) of each and lane id -> t (K,) [m] of its outer border.

        Id 0 is the centre line.
        """
        starts = [section.s for section in self._sections]
        number = np.clip(np.searchsorted(starts, s + 1e-9, side="right") - 1, 0, None)
        for i in np.unique(number).tolist():
            inside = s[number == i]
            yield inside, self._sections[i].borders(inside, self._offset.at(inside))

    def borders(self, s: float) -> dict[int, float]:
        """Map lane id -> t [m] of its outer border at `s` [m]; id 0 is the centre line."""
        ((_, by_lane),) = self.sections(np.array([s]))
        return {lane: float(t[0]) for lane, t in by_lane.items()}

    def lane_centre(self, s: float, lane: int) -> float:
        """Compute t [m] of the middle of a lane at `s` [m]; raises `KeyError` where there is no such lane."""
        borders = self.borders(s)
        return (borders[lane] + borders[lane - int(np.sign(lane))]) / 2

    def _shape(self, s: Array, t: Array) -> Array:
        """Compute the height (N,) [m] of the lateral shapes, interpolated linearly in s between two of them."""
        if not self._shapes:
            return np.zeros(len(s))
        starts = np.array([start for start, _ in self._shapes])
        heights = np.stack([shape.at(t) for _, shape in self._shapes])
        after = np.clip(np.searchsorted(starts, s, side="right"), 1, max(len(starts) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(starts) - 1)
        room = np.maximum(starts[after] - starts[before], 1e-9)
        share = np.clip((s - starts[before]) / room, 0.0, 1.0)
        columns = np.arange(len(s))
        return (1 - share) * heights[before, columns] + share * heights[after, columns]


class Section:
    """A lane section: the widths or borders of its lanes."""

    def __init__(self, row: ElementTree.Element) -> None:
        """Read a <laneSection> that keeps to `standard`."""
        self.s = float(row.attrib["s"])
        lanes = [lane for side in ("left", "right") for lane in row.iterfind(f"{side}/lane")]
        self.kinds = {int(lane.attrib["id"]): lane.get("type", "none") for lane in lanes}
        self._widths = {int(lane.attrib["id"]): Cubics(lane.iterfind("width"), "sOffset") for lane in lanes}
        self._borders = {
            int(lane.attrib["id"]): Cubics(lane.iterfind("border"), "sOffset")
            for lane in lanes
            if lane.find("width") is None and lane.find("border") is not None
        }

    def borders(self, s: Array, offset: Array) -> dict[int, Array]:
        """Map lane id -> t (K,) [m] of its outer border at `s` (K,) [m].

        `offset` (K,) is t of the centre line [m], which has the id 0.
        """
        along = s - self.s
        out = {0: offset}
        for lane in sorted(self.kinds, key=abs):
            side = 1 if lane > 0 else -1
            if lane in self._borders:
                out[lane] = offset + self._borders[lane].at(along)
            else:
                out[lane] = out[lane - side] + side * np.maximum(self._widths[lane].at(along), 0.0)
        return out


def _is_cubic(row: ElementTree.Element) -> bool:
    """Return whether the s and the coefficients of a row are finite numbers."""
    try:
        return bool(np.isfinite([float(row.get(name, "nan")) for name in ("s", *"abcd")]).all())
    except ValueError:
        return False
