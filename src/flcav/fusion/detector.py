"""The trained roadside detector: SECOND on the returns that stand before a pole's static background.

Its weights come with the package (the network "road" of the task objects). It was trained in the towns `TRAINED_IN`;
its score threshold was fixed there, on frames of other scenes. A sensor that stands still knows the map around it, and
what it takes for a car off the drivable surface is none. Where the map has heights, it sees the street flattened:
each return as high above the sensor's foot as it is above the ground below it, since the network knows level streets.
How well it works elsewhere is in `reproductions/road-detector`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Array32
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, transform_points
from flcav.perception.agents import frame_reader
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.task import SIGNS
from flcav.perception.weights import find_shipped, load_network
from flcav.world.map.relief import Relief

ROAD = "shipped/road.safetensors"  # relative to the folder of the task objects; of pictures, to that of signs
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
    """Return the package's network that finds cars in pictures of roadside cameras, trained in the same towns."""
    return load_network(SIGNS, find_shipped(SIGNS, ROAD))


def road_detector(data: Dataset, threshold: float = THRESHOLD) -> Callable[[int], Boxes]:
    """Return the function that detects objects in a roadside frame of `data` by its number.

    It returns boxes in the world frame with actor category, score of `threshold` or more, and variances. Without a map,
    as of an imported dataset, boxes anywhere are returned.
    """
    network, town = load_road_network(), data.town()
    read = frame_reader(data, network.config.foreground)
    surface = None if town is None else shapely.union_all([Polygon(outline) for outline in town.roads])
    relief = None if town is None else town.relief

    def find(number: int) -> Boxes:
        frame = read(number)
        lidar = choose_lidar(frame)
        points, world_from_lidar = frame.lidar[lidar], frame.world_from_sensor(lidar)
        if relief is not None:
            points = flatten_ground(points, world_from_lidar, relief)
        found = detect(network, points, score_threshold=threshold)
        category = np.array([CATEGORY[str(name)] for name in found.label], dtype=np.str_)
        told = replace(found, label=category).transform(world_from_lidar)
        if relief is not None:
            told = replace(told, center=told.center + rise_from(world_from_lidar, told.center, relief))
        return told if surface is None else keep_on_surface(told, surface)

    return find


def flatten_ground(points: Array32, world_from_lidar: Array, relief: Relief) -> Array32:
    """Return points (N, >= 3) [m], LiDAR frame, as they would lie if all ground were as high as that below the sensor.

    Each keeps its place on the map and its height above the ground there.
    """
    world = transform_points(world_from_lidar, points[:, :3].astype(np.float64))
    level = transform_points(inverse(world_from_lidar), world - rise_from(world_from_lidar, world, relief))
    return np.column_stack((level, points[:, 3:])).astype(np.float32)


def rise_from(world_from_lidar: Array, places: Array, relief: Relief) -> Array:
    """Return (N, 3) how far the ground rises from the sensor's foot to below `places` (N, 3), world frame [m]."""
    rise = relief.heights(*places[:, :2].T) - relief.heights(*world_from_lidar[:2, 3])
    return np.column_stack((np.zeros((len(places), 2)), rise))


def keep_on_surface(boxes: Boxes, surface: BaseGeometry) -> Boxes:
    """Return the boxes, world frame, whose centres lie on the drivable `surface` or within `OFF_ROAD_M` of it."""
    return boxes[shapely.distance(shapely.points(boxes.center[:, :2]), surface) <= OFF_ROAD_M]
