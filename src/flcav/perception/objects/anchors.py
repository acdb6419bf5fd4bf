"""The anchors of a network: one box per class and heading at the centre of every cell of the head's grid."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import HEADINGS, head_shape

Array = NDArray[np.float64]


def cell_size(config: SecondConfig) -> tuple[float, float]:
    """Return the x and y size [m] of a cell of the head's grid."""
    rows, columns = head_shape(config)
    x0, y0, _, x1, y1, _ = config.range_m
    return (x1 - x0) / columns, (y1 - y0) / rows


@lru_cache(maxsize=4)
def anchor_boxes(config: SecondConfig) -> Array:
    """Return (A, 7) anchors x, y, z, length, width, height, yaw (LiDAR frame), A = rows, columns, class, heading."""
    rows, columns = head_shape(config)
    dx, dy = cell_size(config)
    boxes = np.zeros((rows, columns, len(config.anchors), HEADINGS, 7))
    boxes[..., 0] = (config.range_m[0] + (np.arange(columns) + 0.5) * dx)[None, :, None, None]
    boxes[..., 1] = (config.range_m[1] + (np.arange(rows) + 0.5) * dy)[:, None, None, None]
    for index, anchor in enumerate(config.anchors):
        boxes[:, :, index, :, 2] = config.ground_z_m + anchor.height_m / 2
        boxes[:, :, index, :, 3:6] = anchor.length_m, anchor.width_m, anchor.height_m
    boxes[..., 1, 6] = np.pi / 2
    flat = boxes.reshape(-1, 7)
    flat.flags.writeable = False
    return flat


@lru_cache(maxsize=4)
def anchor_classes(config: SecondConfig) -> NDArray[np.int64]:
    """Return (A,) the class index of every anchor."""
    rows, columns = head_shape(config)
    classes = np.tile(np.repeat(np.arange(len(config.anchors)), HEADINGS), rows * columns)
    classes.flags.writeable = False
    return classes
