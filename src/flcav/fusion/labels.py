"""Pseudo-labels of a vehicle's LiDAR sweep: detections of its frozen network, fused with roadside labels.

- A roadside box replaces the vehicle's detection of the same object.
- A detection is dropped where the roadside sensor observed the ground or other returns and labelled no object.
- An anchor is a negative only where the vehicle observed free ground, or the roadside sensor free ground or returns;
  elsewhere it is ignored.
- Where there is a roadside sensor, the vehicle's detections train classification alone, not size and pose: against the
  roadside boxes the network would only learn its own output again. Without one they train both, which keeps boxes from
  drifting.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Array32, Ints, Mask
from flcav.fusion.road import CELL_M, GROUND_M, TOP_M, RoadView, find_free_cells
from flcav.geometry import Boxes, concatenate, inverse, points_in_boxes, transform_points
from flcav.perception.objects.config import ECHO, SecondConfig
from flcav.perception.objects.modalities import read_cloud
from flcav.perception.objects.samples import Sample, crop_to_range, move_sample
from flcav.perception.objects.truth import detection_labels, is_lookalike, network_from_lidar
from flcav.sensors.frame import Frame
from flcav.world.map.relief import Relief

CONTRADICTED = 0.5  # a detection is dropped where roadside sensors observed more than this share of its footprint
SAME_OBJECT_M = 1.0  # boxes of roadside sensors with centres at most this far apart are of one object


def label_sample(
    frame: Frame,
    detections: Boxes,
    views: Sequence[RoadView],
    config: SecondConfig,
    lidar: str = "lidar",
    relief: Relief | None = None,
) -> Sample:
    """Return a training sample of a vehicle's `frame`, labelled without ground truth; network's frame.

    `detections`: those of the frozen network above its score threshold, LiDAR frame. `views`: of the roadside sensors
    at the same spin, world frame; without any, the detections are the only labels. Targets are the roadside boxes of
    the network's classes from which the vehicle has returns, then the detections that no view contradicts. Roadside
    boxes without a return, and of lookalike classes (trucks, buses), are ignored in the loss. `free` holds the cell
    centres that the vehicle observed as free ground or a roadside sensor observed; `exact` marks the roadside boxes.
    `relief`: heights of the ground, world frame; None where it is level.
    """
    world_from_lidar = frame.world_from_sensor(lidar)
    points = crop_to_range(read_cloud(frame, config, lidar), config)
    roadside = concatenate([view.boxes for view in views])
    roadside = roadside[_distinct(roadside)].transform(inverse(world_from_lidar))
    label = detection_labels(roadside.label, config.classes)
    road = Boxes(roadside.center, roadside.size, roadside.yaw, label)
    targets = (label != "") & (points_in_boxes(points, roadside, margin_m=0.1).sum(axis=1) > 0)
    ignored = ((label != "") & ~targets) | is_lookalike(roadside.label, config.classes)

    cells = cell_centers(config)
    height = float(frame.agent_from_sensor[lidar][2, 3])
    cells_world = transform_points(world_from_lidar, np.c_[cells, np.full(len(cells), -height)])[:, :2]
    looked = np.zeros(len(cells), dtype=bool)
    for view in views:
        looked |= view.at(view.ground, cells_world) | view.at(view.occupied, cells_world)
    remaining = detections[~_contradicted(detections, roadside, cells, looked)]
    known = find_free_ground(frame, points, cells, lidar, relief) | looked
    boxes = concatenate([road[targets], remaining])
    exact = np.arange(len(boxes)) < targets.sum() if views else None
    sample = Sample(points, boxes, road[ignored], cells[known].astype(np.float32), exact)
    return move_sample(sample, network_from_lidar(frame, config, lidar))


def label_by_tracks(
    frame: Frame,
    tracks: Boxes,
    threshold: float,
    views: Sequence[RoadView],
    config: SecondConfig,
    lidar: str = "lidar",
    free: Array | None = None,
) -> Sample:
    """Return a training sample of a vehicle's `frame`, labelled by the tracks of its drive; network's frame.

    Targets are the tracks (LiDAR frame) that score `threshold` or more and from which this sweep has returns; others,
    and boxes of lookalike classes in the `views` of roadside sensors, are ignored in the loss. Elsewhere is background,
    since tracks of low score are kept, too; or, where the tracks are not of all objects, only the cells whose centres
    (K, 2) [m] `free` gives, LiDAR frame.
    """
    assert tracks.score is not None
    points = crop_to_range(read_cloud(frame, config, lidar), config)
    roadside = concatenate([view.boxes for view in views]).transform(inverse(frame.world_from_sensor(lidar)))
    targets = (tracks.score >= threshold) & (points_in_boxes(points, tracks, margin_m=0.1).sum(axis=1) > 0)
    boxes = replace(tracks, score=None, variance=None)
    ignored = concatenate([boxes[~targets], roadside[is_lookalike(roadside.label, config.classes)]])
    background = None if free is None else free.astype(np.float32)
    return move_sample(Sample(points, boxes[targets], ignored, background), network_from_lidar(frame, config, lidar))


def _distinct(boxes: Boxes) -> Ints:
    """Return the indices of boxes that do not duplicate an earlier one, as when two poles label the same car."""
    kept: list[int] = []
    for i, center in enumerate(boxes.center):
        if all(np.hypot(*(center - boxes.center[j])[:2]) > SAME_OBJECT_M for j in kept):
            kept.append(i)
    return np.array(kept, dtype=np.int64)


def cell_centers(config: SecondConfig) -> Array:
    """Return the centres (K, 2) of the cells of `CELL_M` over the detector's range, x first, LiDAR frame [m]."""
    x0, y0, _, x1, y1, _ = config.range_m
    x = np.arange(x0 + CELL_M / 2, x1, CELL_M)
    y = np.arange(y0 + CELL_M / 2, y1, CELL_M)
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _contradicted(detections: Boxes, roadside: Boxes, cells: NDArray, looked: Mask) -> Mask:
    """Return (N,) whether a roadside sensor labelled an object at a detection's place, or observed the place.

    `roadside` are the boxes of roadside sensors, `cells` (K, 2) cell centres [m], both in the LiDAR frame; `looked`
    (K,) marks the cells that these sensors observed.
    """
    flat = [1.0, 1.0, 0.0]
    # In the plane: the boxes at height 0, one metre high.
    footprints = Boxes(detections.center * flat, detections.size * flat + [0, 0, 1], detections.yaw, detections.label)
    inside = points_in_boxes(np.c_[cells, np.zeros(len(cells))], footprints)
    seen = (inside & looked).sum(axis=1) > CONTRADICTED * np.maximum(inside.sum(axis=1), 1)
    offset = np.linalg.norm(detections.center[:, None, :2] - roadside.center[None, :, :2], axis=-1)
    return seen | (offset < roadside.size[None, :, 0] / 2).any(axis=1)


def find_free_ground(frame: Frame, points: Array32, cells: Array, lidar: str, relief: Relief | None) -> Mask:
    """Return (K,) whether the vehicle saw the ground within two cells of each cell, and nothing standing within two.

    `points` (N, C) of the sweep and the centres `cells` (K, 2) are in the LiDAR frame. `relief`: as of `label_sample`.
    """
    points = points[points[:, 3] != ECHO]
    above = points[:, 2] + float(frame.agent_from_sensor[lidar][2, 3])
    if relief is not None:
        world_from_lidar = frame.world_from_sensor(lidar)
        above = relief.above(transform_points(world_from_lidar, points[:, :3].astype(np.float64)))
    origin = cells[0] - CELL_M / 2
    shape = np.round((cells[-1] - cells[0]) / CELL_M).astype(int) + 1
    index = np.floor((points[:, :2] - origin) / CELL_M).astype(np.int64)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    index = index[inside]
    z = above[inside]

    def hit(returns: Mask) -> Mask:
        grid = np.zeros(shape, dtype=bool)
        grid[index[returns, 0], index[returns, 1]] = True
        return grid

    ground = hit((z > GROUND_M[0]) & (z < GROUND_M[1]))
    standing = hit((z >= GROUND_M[1]) & (z < TOP_M))
    return find_free_cells(ground, standing).ravel()
