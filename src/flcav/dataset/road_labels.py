"""Labels of the road in a camera's picture: a class of marking by pixel, and the visible lane lines as polylines.

They come from the town's map. Areas (crossings, arrows, stop lines) are looked up at the place on the ground that each
pixel shows, by its recorded depth. Lines (lane lines, road edges, stop lines again) are drawn along their visible
sections, at least `LEAST_PX` wide as in CULane, whose labels are 16 of 1640 pixels wide (Pan et al., "Spatial As Deep:
Spatial CNN for Traffic Scene Understanding", AAAI 2018). What hides a marking is what the renderer shows there: pixels
of anything but ground have no label. Gaps of a broken line belong to it; a crossing is its whole area.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from PIL import Image, ImageDraw
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Bytes, Mask
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points
from flcav.sensors.frame import SEMANTICS, Frame
from flcav.sensors.lens import project_points, unproject_pixels
from flcav.world.map.lane_lines import LaneLine, join_lane_lines
from flcav.world.map.lanes import map_layers
from flcav.world.map.layers import MapLayers, Marking, outline_arrow, outline_dashes
from flcav.world.map.town import Town

ROAD_CLASSES = ("background", "solid", "broken", "road_edge", "stop_line", "crossing", "arrow")
BACKGROUND, SOLID, BROKEN, ROAD_EDGE, STOP_LINE, CROSSING, ARROW = range(len(ROAD_CLASSES))
IGNORED = 255  # of ground beyond the reach: neither a class nor background
CLASS_OF = {"solid": SOLID, "edge": SOLID, "dashed": BROKEN, "stop_line": STOP_LINE, "yield_line": STOP_LINE}
ACROSS = (STOP_LINE,)  # classes of markings across the road
REACH_M = 40.0  # distance up to which the road is labelled
LEAST_PX, LEAST_STOP_PX = 6, 3  # least drawn width of a line along the road, and of one across it
GROUND = tuple(SEMANTICS[name] for name in ("road", "road_line", "sidewalk", "terrain"))
NEAREST_M = 0.5  # least depth of a drawn point
HIDDEN_SHARE, HIDDEN_M = 0.05, 0.3  # a point is hidden if the picture's depth there is less by this share and length
BRIDGED_M = 4.0  # hidden sections up to this length are part of a line
SHORTEST_M, LOWEST_PX = 5.0, 12.0  # least length of a polyline, and least height in the picture
FLATTEST = 0.15  # least slope of a polyline in the picture, rows over columns: flatter ones lead across
STEP_M = 0.5  # distance of the points of a road's edge


@dataclass(frozen=True)
class SeenLine:
    """The visible section of a lane line in a picture, from its near end to its far end."""

    pixels: Array  # (K, 2) u, v [px]; the centre of the first pixel is (0, 0)
    ground: Array  # (K, 3) agent's frame: x forward, y left, z up [m]
    kind: str  # "solid" or "broken", whichever most of its points are


@dataclass(frozen=True)
class RoadLabels:
    """Labels of a picture."""

    classes: Bytes  # (H, W) index in `ROAD_CLASSES`, or IGNORED
    lines: tuple[SeenLine, ...]


@dataclass(frozen=True)
class RoadMarks:
    """The markings of a town as they are drawn, world frame."""

    lines: tuple[LaneLine, ...]
    edges: tuple[Array, ...]  # (K, 2) borders of the road [m]
    stops: tuple[LaneLine, ...]  # stop lines and give-way lines
    areas: tuple[tuple[int, BaseGeometry], ...]  # class and outline of crossings, stop lines and arrows [m]


def road_marks(layers: MapLayers) -> RoadMarks:
    """Return the markings of a map; raises `InputError` for a kind of marking that has no class."""
    for marking in layers.markings:
        class_of_marking(marking)
    roads = shapely.union_all([Polygon(outline) for outline in layers.roads]).buffer(0.01).buffer(-0.01)
    stops = [marking for marking in layers.markings if class_of_marking(marking) in ACROSS]
    areas: list[tuple[int, BaseGeometry]] = [(CROSSING, Polygon(one.outline)) for one in layers.crossings]
    areas += [(STOP_LINE, Polygon(outline)) for marking in stops for outline in outline_dashes(marking)]
    areas += [(ARROW, Polygon(outline_arrow(arrow))) for arrow in layers.arrows]
    borders = shapely.get_parts(shapely.segmentize(roads, STEP_M).boundary)
    return RoadMarks(
        lines=join_lane_lines(layers.markings),
        edges=tuple(shapely.get_coordinates(shapely.get_parts(border)) for border in borders),
        stops=tuple(LaneLine(_densify(one.line), np.ones(0, np.bool_), one.width_m) for one in stops),
        areas=tuple(areas),
    )


def class_of_marking(marking: Marking) -> int:
    """Return the index in `ROAD_CLASSES` of a marking; raises `InputError` for an unknown kind."""
    if marking.kind not in CLASS_OF:
        raise InputError(f"a map with markings '{marking.kind}', which have no class; known are {', '.join(CLASS_OF)}")
    return CLASS_OF[marking.kind]


def _densify(line: Array) -> Array:
    return shapely.get_coordinates(shapely.segmentize(shapely.LineString(line), STEP_M))


@lru_cache(maxsize=8)
def _marks_of(data: Dataset) -> tuple[Town, RoadMarks]:
    """Return the town of a dataset and its markings; raises `InputError` where it is unknown."""
    town = data.town()
    if town is None or data.manifest.imported:
        raise InputError(f"{data.folder}: without a map of its town, which labels of the road come from")
    return town, road_marks(map_layers(town))


def check_road_labels(data: Dataset) -> None:
    """Raise `InputError` where the pictures of a dataset cannot be labelled: it was imported, or has no town."""
    _marks_of(data)


def label_road(data: Dataset, number: int, camera: str) -> RoadLabels:
    """Return the labels of a recorded picture, by the true calibration; raises `InputError` as `check_road_labels`."""
    town, marks = _marks_of(data)
    frame = data.frame(number)
    view = _View.of(data, frame, number, camera, town)
    classes = _draw_areas(view, marks.areas)
    drawn = _draw_lines(view, marks)
    classes = np.where((drawn > 0) & view.ground & (classes != ARROW), drawn, classes)
    classes[view.ground & (view.distance > REACH_M)] = IGNORED
    return RoadLabels(classes, tuple(line for one in marks.lines for line in _see(view, one)))


@dataclass(frozen=True)
class _View:
    """A picture with what is known of its pixels, and the projection of the world into it."""

    camera_from_world: Array  # (4, 4)
    agent_from_world: Array  # (4, 4)
    intrinsics: Array
    distortion: Array
    town: Town
    depth: Array  # (H, W) [m]
    ground: Mask  # (H, W) whether a pixel shows ground
    place: Array  # (H, W, 2) x, y that it shows, world frame [m]; NaN where it shows no ground
    distance: Array  # (H, W) of that place from the camera, level [m]

    @classmethod
    def of(cls, data: Dataset, frame: Frame, number: int, camera: str, town: Town) -> "_View":
        depth = data.plane(number, camera, "depth_m").astype(np.float64)
        ground = np.isin(data.plane(number, camera, "semantic"), GROUND)
        world_from_camera = frame.world_from_sensor(camera)
        intrinsics, distortion = frame.calibration.intrinsics[camera], frame.calibration.distortion[camera]
        rows, columns = np.nonzero(ground)
        plane = unproject_pixels(intrinsics, distortion, np.stack((columns, rows), axis=1).astype(np.float64))
        level = world_from_camera[:2]  # the rows of x and y
        away = depth[rows, columns, None] * (plane @ level[:, :2].T + level[:, 2])
        place = np.full((*depth.shape, 2), np.nan)
        distance = np.full(depth.shape, np.nan)
        place[rows, columns] = away + level[:, 3]
        distance[rows, columns] = np.hypot(*away.T)
        return cls(
            inverse(world_from_camera),
            inverse(frame.agent_at_trigger.get(camera, frame.world_from_agent)),
            intrinsics,
            distortion,
            town,
            depth,
            ground,
            place,
            distance,
        )

    def lift(self, points: Array) -> Array:
        """Return points (K, 2) of the world on the ground, (K, 3) [m]."""
        return np.column_stack((points, self.town.grounds(*points.T)))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return pixels (K, 2) and depth (K,) [m] of points (K, 3); NaN behind the camera and far off the picture."""
        seen = transform_points(self.camera_from_world, points)
        seen[seen[:, 2] < NEAREST_M] = np.nan
        size = np.array(self.depth.shape[::-1])
        straight = project_points(self.intrinsics, np.zeros(5), seen)  # a distortion folds back what is far off
        near = np.all((straight > -size) & (straight < 2 * size), axis=1)
        return project_points(self.intrinsics, self.distortion, np.where(near[:, None], seen, np.nan)), seen[:, 2]

    def shows(self, pixels: Array, depth: Array) -> Mask:
        """Return which of the points with these pixels (K, 2) and depths (K,) are visible: no other is in front."""
        height, width = self.depth.shape
        nearest = np.nan_to_num(np.round(pixels), nan=-1).astype(int)
        inside = np.all((nearest >= 0) & (nearest < (width, height)), axis=1)
        column, row = np.where(inside[:, None], nearest, 0).T
        met = self.depth[row, column] > depth - HIDDEN_SHARE * depth - HIDDEN_M
        return inside & met & self.ground[row, column]

    def around(self, points: Array) -> Mask:
        """Return which of the points (K, 2) of the world are within the reach."""
        centre = inverse(self.camera_from_world)[:2, 3]
        return np.hypot(*(points - centre).T) <= REACH_M


def _draw_areas(view: _View, areas: Sequence[tuple[int, BaseGeometry]]) -> Bytes:
    """Return the classes (H, W) of the pixels whose place lies in an area."""
    classes = np.zeros(view.depth.shape, np.uint8)
    rows, columns = np.nonzero(view.ground & (view.distance <= REACH_M))
    x, y = view.place[rows, columns].T
    if not len(x):
        return classes
    box = shapely.box(x.min(), y.min(), x.max(), y.max())
    for label, area in areas:
        if not area.intersects(box):
            continue
        low_x, low_y, high_x, high_y = area.bounds
        near = np.flatnonzero((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y))
        inside = near[shapely.contains_xy(area, x[near], y[near])]
        classes[rows[inside], columns[inside]] = label
    return classes


def _draw_lines(view: _View, marks: RoadMarks) -> Bytes:
    """Return the classes (H, W) of the visible sections of lines, 0 elsewhere; what hides them is not cut out."""
    height, width = view.depth.shape
    image = Image.new("L", (width, height))
    draw = ImageDraw.Draw(image)
    for edge in marks.edges:
        _stroke(view, draw, edge, 0.0, np.full(len(edge), ROAD_EDGE), LEAST_PX)
    for line in marks.lines:
        _stroke(view, draw, line.points, line.width_m, np.where(line.solid, SOLID, BROKEN), LEAST_PX)
    for line in marks.stops:
        _stroke(view, draw, line.points, 0.0, np.full(len(line.points), STOP_LINE), LEAST_STOP_PX)
    return np.array(image)


def _stroke(
    view: _View, draw: ImageDraw.ImageDraw, points: Array, width_m: float, label: np.ndarray, least: int
) -> None:
    """Draw the visible segments of a line (K, 2) [m] of `width_m`, at least `least` pixels wide, each by its label."""
    near = view.around(points)
    if not near.any():
        return
    pixels, depth = view.project(view.lift(points))
    seen = view.shows(pixels, depth) & near
    step = np.diff(pixels, axis=0)
    ahead = np.gradient(points, axis=0) if len(points) > 1 else np.ones_like(points)
    left = np.stack((-ahead[:, 1], ahead[:, 0]), axis=1) / np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), 1e-9)[:, None]
    aside, _ = view.project(view.lift(points + width_m * left))
    across = (aside - pixels)[:-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        wide = np.abs(step[:, 0] * across[:, 1] - step[:, 1] * across[:, 0]) / np.hypot(*step.T)
    wide = np.maximum(np.nan_to_num(wide, posinf=0.0), least).round().astype(int)
    for number in np.flatnonzero((seen[:-1] | seen[1:]) & np.isfinite(step).all(axis=1)).tolist():
        ends = [tuple(pixels[number].tolist()), tuple(pixels[number + 1].tolist())]
        draw.line(ends, fill=int(label[number]), width=int(wide[number]))


def _see(view: _View, line: LaneLine) -> list[SeenLine]:
    """Return the visible sections of a lane line that are long enough and lead away from the camera."""
    near = view.around(line.points)
    if not near.any():
        return []
    world = view.lift(line.points)
    pixels, depth = view.project(world)
    seen = np.flatnonzero(view.shows(pixels, depth) & near)
    if not len(seen):
        return []
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line.points, axis=0).T))))
    gaps = np.flatnonzero(np.diff(along[seen]) > BRIDGED_M) + 1
    found = []
    for part in np.split(seen, gaps):
        whole = slice(part[0], part[-1] + 1)
        u, v = pixels[whole].T
        if along[part[-1]] - along[part[0]] < SHORTEST_M or not leads_away(pixels[whole]):
            continue
        solid = line.solid[part].mean() >= 0.5
        order = slice(None) if v[0] >= v[-1] else slice(None, None, -1)
        kept = np.isfinite(u)
        ground = transform_points(view.agent_from_world, world[whole])
        found.append(SeenLine(pixels[whole][kept][order], ground[kept][order], "solid" if solid else "broken"))
    return found


def leads_away(pixels: Array) -> bool:
    """Return whether a polyline (K, 2) [px] is as high in the picture as one that leads away from the camera."""
    u, v = pixels[np.isfinite(pixels).all(axis=1)].T
    if not len(u):
        return False
    high, wide = float(np.ptp(v)), float(np.ptp(u))
    return high >= LOWEST_PX and high >= FLATTEST * wide
