"""Labels for a vehicle that has no ground truth: its frozen network's own detections, and what the road tells it.

A box of the road sensor wins over the vehicle's own; what the road looked at and did not label is no object. Where
neither saw free ground nor the road anything at all, nothing is known and an anchor there is ignored. Beside a road
sensor a vehicle's own detection says that there is an object, not how large: its box is what the network would answer
anyway, and to learn it would hold the network back from what the road's boxes teach. Without a road sensor it is all
there is, and keeps the boxes from drifting.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.fusion.road import CELL_M, GROUND_M, TOP_M, RoadView, free_cells
from flcav.geometry import Boxes, concatenate, inverse, points_in_boxes, transform_points
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample, near_range
from flcav.perception.objects.truth import detection_labels, is_lookalike
from flcav.sensors.frame import Frame

CONTRADICTED = 0.5  # a detection is dropped where the road looked at more than this share of its footprint
SAME_OBJECT_M = 1.0  # boxes of two road sensors with centres nearer than this are of one object


def label_sample(
    frame: Frame, detections: Boxes, views: Sequence[RoadView], config: SecondConfig, lidar: str = "lidar"
) -> Sample:
    """Return a training sample of a vehicle's `frame`, labelled without ground truth.

    `detections`: the frozen network's own, LiDAR frame, already cut at its threshold. `views`: the road sensors' at the
    same spin (none: own labels only). A road label of an object that the vehicle has no return from is ignored in the
    loss, and so are trucks and buses.
    """
    world_from_lidar = frame.world_from_sensor(lidar)
    points = near_range(frame.lidar[lidar], config)
    told = concatenate([view.boxes for view in views])
    told = told[_distinct(told)].transformed(inverse(world_from_lidar))
    label = detection_labels(told.label, config.classes)
    road = Boxes(told.center, told.size, told.yaw, label)
    targets = (label != "") & (points_in_boxes(points, told, margin_m=0.1).sum(axis=1) > 0)
    ignored = ((label != "") & ~targets) | is_lookalike(told.label, config.classes)

    cells = _cell_centers(config)
    height = float(world_from_lidar[2, 3])
    cells_world = transform_points(world_from_lidar, np.c_[cells, np.full(len(cells), -height)])[:, :2]
    looked = np.zeros(len(cells), dtype=bool)
    for view in views:
        looked |= view.at(view.ground, cells_world) | view.at(view.occupied, cells_world)
    own = detections[~_contradicted(detections, told, cells, looked)]
    known = _free_ground(points, height, cells) | looked
    boxes = concatenate([road[targets], own])
    exact = np.arange(len(boxes)) < targets.sum() if views else None
    return Sample(points, boxes, road[ignored], cells[known].astype(np.float32), exact)


def _distinct(boxes: Boxes) -> NDArray[np.int64]:
    """Return the indices of boxes that are not an earlier one again: two poles may label one car."""
    kept: list[int] = []
    for i, center in enumerate(boxes.center):
        if all(np.hypot(*(center - boxes.center[j])[:2]) > SAME_OBJECT_M for j in kept):
            kept.append(i)
    return np.array(kept, dtype=np.int64)


def _cell_centers(config: SecondConfig) -> NDArray[np.float64]:
    """Return (K, 2) centres of the known-free grid over the detector's range, LiDAR frame."""
    x0, y0, _, x1, y1, _ = config.range_m
    x, y = np.arange(x0 + CELL_M / 2, x1, CELL_M), np.arange(y0 + CELL_M / 2, y1, CELL_M)
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _contradicted(detections: Boxes, told: Boxes, cells: NDArray, looked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (N,): the road labelled the same place itself, or looked there and labelled nothing."""
    flat = [1.0, 1.0, 0.0]
    footprints = Boxes(detections.center * flat, detections.size * flat + [0, 0, 1], detections.yaw, detections.label)
    inside = points_in_boxes(np.c_[cells, np.zeros(len(cells))], footprints)
    seen = (inside & looked).sum(axis=1) > CONTRADICTED * np.maximum(inside.sum(axis=1), 1)
    offset = np.linalg.norm(detections.center[:, None, :2] - told.center[None, :, :2], axis=-1)
    return seen | (offset < told.size[None, :, 0] / 2).any(axis=1)


def _free_ground(points: NDArray[np.float32], height: float, cells: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (K,): the vehicle saw ground in the cell or beside it, and nothing that stands there or beside it.

    `height` of the LiDAR above the ground [m].
    """
    origin = cells[0] - CELL_M / 2
    shape = np.round((cells[-1] - cells[0]) / CELL_M).astype(int) + 1
    index = np.floor((points[:, :2] - origin) / CELL_M).astype(np.int64)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    index, z = index[inside], points[inside, 2] + height

    def hit(returns: NDArray[np.bool_]) -> NDArray[np.bool_]:
        grid = np.zeros(shape, dtype=bool)
        grid[index[returns, 0], index[returns, 1]] = True
        return grid

    ground, standing = hit((z > GROUND_M[0]) & (z < GROUND_M[1])), hit((z >= GROUND_M[1]) & (z < TOP_M))
    return free_cells(ground, standing).ravel()
