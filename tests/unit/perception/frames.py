"""Frames with hand-made annotations."""

import numpy as np

from flcav.geometry import Boxes, pose, transform_points
from flcav.sensors.frame import Annotations, Calibration, Frame

SENSOR_HEIGHT_M = 1.8


def frame(objects, *, points=None, scene="s0", index=0, agent="cav0", at=(0.0, 0.0), yaw=0.0):
    """Return a frame whose agent stands at `at`; objects are (track, category, x, y, returns) in the agent's frame."""
    world_from_agent = pose(at[0], at[1], 0, yaw)
    sizes = {"bus": (12.0, 2.5, 3.1), "pedestrian": (0.6, 0.6, 1.8)}
    rows = [(x, y, 0.8, *sizes.get(kind, (4.4, 1.8, 1.6)), 0.0) for _, kind, x, y, _ in objects]
    boxes = Boxes.from_array(np.array(rows).reshape(-1, 7), [kind for _, kind, *_ in objects])
    annotations = Annotations(
        track=np.array([track for track, *_ in objects], dtype=np.str_),
        boxes=boxes.transform(world_from_agent),
        velocity=np.zeros((len(objects), 3)),
        acceleration=np.zeros((len(objects), 3)),
        returns=np.array([returns for *_, returns in objects], dtype=np.int64),
        occlusion=np.full(len(objects), 0.25),
    )
    cloud = np.zeros((1, 4), dtype=np.float32) if points is None else points
    mounts = Calibration({"top": pose(0, 0, SENSOR_HEIGHT_M)})
    return Frame(scene, index, 0.1 * index, agent, world_from_agent, mounts, mounts, {"top": cloud}, annotations)


def detections(*rows, label="Car"):
    """Return boxes in the LiDAR frame from rows (x, y, score) as `frame` stands objects on the ground."""
    array = [(x, y, 0.8 - SENSOR_HEIGHT_M, 4.4, 1.8, 1.6, 0.0) for x, y, _ in rows]
    return Boxes.from_array(np.array(array).reshape(-1, 7), label, [score for *_, score in rows])


def cloud_in(boxes, each=6):
    """Return a point cloud with `each` points inside every box."""
    unit = np.random.default_rng(0).uniform(-0.3, 0.3, (len(boxes), each, 3))
    points = [
        transform_points(pose(c[0], c[1], c[2], y), u * s)
        for c, s, y, u in zip(boxes.center, boxes.size, boxes.yaw, unit)
    ]
    return np.pad(np.concatenate(points), ((0, 0), (0, 1))).astype(np.float32)
