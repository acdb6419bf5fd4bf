"""What was recorded, as a peer is to find it."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flcav.geometry import Boxes, inverse, points_in_boxes, transform_points
from flcav.sensors.frame import Frame


def in_lidar(frame: Frame) -> Boxes:
    """Return the boxes of a frame in its LiDAR's frame."""
    return frame.annotations.boxes.transform(inverse(frame.world_from_sensor(next(iter(frame.lidar)))))


def points_in(frame: Frame) -> NDArray[np.int64]:
    """Return (M,) how many of the LiDAR's points lie in each box of a frame."""
    return points_in_boxes(next(iter(frame.lidar.values())), in_lidar(frame)).sum(axis=1)


def echoes_in(frame: Frame) -> NDArray[np.int64]:
    """Return (M,) how many of the radars' echoes lie in each box of a frame."""
    count = np.zeros(len(frame.annotations), np.int64)
    for name, echoes in frame.radar.items():
        distance, azimuth, elevation = echoes[:, :3].T.astype(np.float64)
        direction = Rotation.from_euler("ZY", np.column_stack((azimuth, -elevation))).apply([1.0, 0.0, 0.0])
        world = transform_points(frame.world_from_sensor(name), distance[:, None] * direction)
        count += points_in_boxes(world, frame.annotations.boxes).sum(axis=1)
    return count
