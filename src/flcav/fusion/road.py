"""Roadside perception of one LiDAR spin: object boxes, and grids of free and occupied cells, sent to the vehicles.

The boxes are those of the trained detector, or of an *ideal* one: it labels exactly the objects from which its LiDAR
has at least `MIN_RETURNS` returns. Every result with the ideal detector is an upper bound.

The trained detector is SECOND on the returns in front of a pole's static background. Its weights are shipped with the
package (the network "road" of the task objects). It was trained in the towns `TRAINED_IN`; its score threshold was
chosen there, on frames of other scenes. A stationary sensor knows the map around it, and its detections of cars off the
drivable surface are dropped. Where the map has heights, the network gets flattened returns, each as high above the
sensor's foot as it is above the ground below it, since it was trained on level streets. Its accuracy in other towns is
in `reproductions/road-detector`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Array32, Mask
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, transform_points
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.agents import frame_reader
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.task import SIGNS
from flcav.perception.weights import find_shipped, load_network
from flcav.sensors.frame import Frame
from flcav.world.map.relief import Relief

MIN_RETURNS = 10  # least number of returns from the roadside LiDAR of an object that is labelled
CELL_M = 0.4  # edge of a cell of the free and occupied grids
REACH = np.ones((5, 5), dtype=bool)  # structuring element: a return counts for the cells up to two away
GROUND_M = (-0.3, 0.3)  # a return between these heights above the road is ground (kerbs are 0.12)
TOP_M = 3.0  # higher returns (crowns, signs, walls) are ignored: they are no evidence about the road below


@dataclass(frozen=True)
class RoadView:
    """Roadside perception of one LiDAR spin, world frame: labelled boxes, free cells and occupied cells."""

    boxes: Boxes  # labelled objects; label = actor category
    origin: Array  # (2,) world x, y of the corner of cell (0, 0) [m]
    ground: Mask  # (X, Y) cells of CELL_M that were observed as free ground
    occupied: Mask  # (X, Y) cells with returns above the ground

    def at(self, cells: Mask, xy: NDArray) -> Mask:
        """Return (K,) the value of the grid `cells` (`ground` or `occupied`) at each world position `xy` (K, 2) [m].

        It is False outside the grid.
        """
        index = np.floor((xy - self.origin) / CELL_M).astype(np.int64)
        inside = ((index >= 0) & (index < cells.shape)).all(axis=1)
        out = np.zeros(len(xy), dtype=bool)
        out[inside] = cells[index[inside, 0], index[inside, 1]]
        return out

    def message(self) -> bytes:
        """Return the view as the message to a vehicle: boxes, and grids with one bit per cell."""
        arrays = {
            "boxes": self.boxes.array(),
            "category": from_names(self.boxes.label.tolist()),
            "origin": self.origin,
            "shape": np.array(self.ground.shape, dtype=np.int32),
            "ground": np.packbits(self.ground),
            "occupied": np.packbits(self.occupied),
        }
        return pack_arrays(arrays)

    @classmethod
    def from_message(cls, message: bytes) -> "RoadView":
        """Return the view in a message: the inverse of `message`."""
        arrays = unpack_arrays(message)
        x, y = arrays["shape"].tolist()
        ground, occupied = (
            np.unpackbits(arrays[name], count=x * y).reshape(x, y).astype(bool) for name in ("ground", "occupied")
        )
        boxes = Boxes.from_array(arrays["boxes"], to_names(arrays["category"]))
        return cls(boxes, arrays["origin"], ground, occupied)


def label_ideally(frame: Frame) -> Boxes:
    """Return the boxes of an ideal detector at the roadside sensor that recorded `frame`, world frame."""
    return frame.annotations.boxes[frame.annotations.returns >= MIN_RETURNS]


def build_road_view(
    frame: Frame, boxes: Boxes, lidar: str = "lidar", relief: Relief | None = None, ground_m: float = 0.0
) -> RoadView:
    """Return the view of the roadside sensor that recorded `frame`: its detected `boxes`, and grids of its LiDAR.

    `boxes`: world frame, label = actor category. The grids cover the returns of the sweep. `relief`: heights of the
    ground; None where it is level, at `ground_m` [m] in the world.
    """
    points = transform_points(frame.world_from_sensor(lidar), frame.lidar[lidar][:, :3].astype(np.float64))
    origin = np.floor(points[:, :2].min(axis=0) / CELL_M) * CELL_M
    shape = tuple(np.floor((points[:, :2].max(axis=0) - origin) / CELL_M).astype(int) + 1)
    ground = np.zeros(shape, dtype=bool)
    occupied = np.zeros(shape, dtype=bool)
    x, y = np.floor((points[:, :2] - origin) / CELL_M).astype(np.int64).T
    above = points[:, 2] - ground_m if relief is None else relief.above(points)
    low = (above > GROUND_M[0]) & (above < GROUND_M[1])
    high = (above >= GROUND_M[1]) & (above < TOP_M)
    ground[x[low], y[low]] = True
    occupied[x[high], y[high]] = True
    return RoadView(boxes, origin, find_free_cells(ground, occupied), occupied)


def find_free_cells(ground: Mask, standing: Mask) -> Mask:
    """Return the cells (X, Y) within two cells of one in `ground` and not within two cells of one in `standing`."""
    return np.asarray(binary_dilation(ground, REACH)) & ~np.asarray(binary_dilation(standing, REACH), dtype=bool)


ROAD = "shipped/road.safetensors"  # relative to the folder of the task objects; for cameras, to that of signs
TRAINED_IN = ("arterial", "suburb")  # towns
THRESHOLD = 0.7  # lowest score of a label
PICTURE_THRESHOLD = 0.07  # lowest score of a car in a picture: chosen in the town `ring`
OFF_ROAD_M = 0.5  # farthest that the centre of a car may lie from the drivable surface of the map
CATEGORY = {"Car": "car"}  # actor category by detection class


@lru_cache(maxsize=1)
def load_road_network() -> Second:
    """Return the package's network for roadside sensors."""
    return load_network(OBJECTS, find_shipped(OBJECTS, ROAD))


@lru_cache(maxsize=1)
def load_picture_network() -> SignDetector:
    """Return the package's network that detects cars in pictures of roadside cameras, trained in the same towns."""
    return load_network(SIGNS, find_shipped(SIGNS, ROAD))


def road_detector(data: Dataset, threshold: float = THRESHOLD) -> Callable[[int], Boxes]:
    """Return the function that detects objects in the roadside frame of `data` with a given number.

    It returns boxes in the world frame with actor category, score of `threshold` or more, and variances. Without a map,
    as of an imported dataset, boxes off the road are returned, too.
    """
    network, town = load_road_network(), data.town()
    read = frame_reader(data, network.config.foreground)
    surface = None if town is None else shapely.union_all([Polygon(outline) for outline in town.roads])
    relief = None if town is None else town.relief

    def find(number: int) -> Boxes:
        frame = read(number)
        lidar = choose_lidar(frame)
        points = frame.lidar[lidar]
        world_from_lidar = frame.world_from_sensor(lidar)
        if relief is not None:
            points = flatten_ground(points, world_from_lidar, relief)
        detections = detect(network, points, score_threshold=threshold)
        category = np.array([CATEGORY[str(name)] for name in detections.label], dtype=np.str_)
        boxes = replace(detections, label=category).transform(world_from_lidar)
        if relief is not None:
            boxes = replace(boxes, center=boxes.center + rise_from(world_from_lidar, boxes.center, relief))
        return boxes if surface is None else keep_on_surface(boxes, surface)

    return find


def flatten_ground(points: Array32, world_from_lidar: Array, relief: Relief) -> Array32:
    """Return points (N, >= 3) [m], LiDAR frame, as if all ground were at the height of that below the sensor.

    A point keeps its place on the map and its height above the ground there.
    """
    world = transform_points(world_from_lidar, points[:, :3].astype(np.float64))
    level = transform_points(inverse(world_from_lidar), world - rise_from(world_from_lidar, world, relief))
    return np.column_stack((level, points[:, 3:])).astype(np.float32)


def rise_from(world_from_lidar: Array, places: Array, relief: Relief) -> Array:
    """Return (N, 3) the rise of the ground from the sensor's foot to below `places` (N, 3), world frame [m]."""
    rise = relief.heights(*places[:, :2].T) - relief.heights(*world_from_lidar[:2, 3])
    return np.column_stack((np.zeros((len(places), 2)), rise))


def keep_on_surface(boxes: Boxes, surface: BaseGeometry) -> Boxes:
    """Return the boxes, world frame, whose centres lie on the drivable `surface` or within `OFF_ROAD_M` of it."""
    return boxes[shapely.distance(shapely.points(boxes.center[:, :2]), surface) <= OFF_ROAD_M]
