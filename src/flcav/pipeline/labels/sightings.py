"""Sightings of vehicles: their poses and clocks by their own navigation, and the boxes that they detect."""

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.fusion.distillation import TOLD, Distillation
from flcav.fusion.navigation import NavigationErrors
from flcav.fusion.posts import find_posts
from flcav.fusion.sightings import Sighting
from flcav.geometry import Boxes, transform_points
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar
from flcav.sensors.frame import Frame
from flcav.statistics.streams import stream


def navigate(data: Dataset, i: int, frame: Frame, errors: NavigationErrors) -> NDArray[np.float64]:
    """Return the pose (4, 4) of the vehicle of `frame`, number `i`, by its navigation, for labels of all kinds."""
    key, recorded = data.keys[i], str(data.manifest.recipe.get("seed"))
    rng = stream(0, "navigation", recorded, key.scene, key.index, key.agent)
    return errors.navigate(frame.world_from_agent, rng)


def make_sighting(
    network: Second, data: Dataset, i: int, how: Distillation, errors: NavigationErrors
) -> tuple[Sighting, Boxes]:
    """Return what the vehicle of frame `i` tells, and its detections in the LiDAR's frame."""
    key, frame = data.keys[i], data.frame(i)
    (found,) = detect_in(network, [frame], score_threshold=TOLD)
    recorded = str(data.manifest.recipe.get("seed"))
    offset_s = errors.clock_s * stream(0, "clock", recorded, key.scene, key.agent).standard_normal()
    boxes = found.transform(frame.assumed.agent_from_sensor[choose_lidar(frame)])
    known, posts = navigate(data, i, frame, errors), find_told_posts(frame, how)
    return Sighting(key.agent, key.time_s + offset_s, known, boxes, posts, errors.stated), found


def find_told_posts(frame: Frame, how: Distillation) -> NDArray[np.float64]:
    """Return the feet (L, 2) x, y [m] of the posts that a vehicle tells of, its frame; none without a pose graph."""
    if not how.pose_graph:
        return np.zeros((0, 2))
    lidar = choose_lidar(frame)
    return find_posts(transform_points(frame.assumed.agent_from_sensor[lidar], frame.lidar[lidar][:, :3]), 0.0)
