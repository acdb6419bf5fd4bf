"""Where in an image each instance shows, in one pass over its pixels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.rays.compiled import compiled

OUTER_EDGES = np.array((-0.5, -0.5, 0.5, 0.5))  # from the centres of the outermost pixels


class Regions(NamedTuple):
    """The visible pixels of K instances."""

    pixels: NDArray[np.int64]  # (K,)
    box: NDArray[np.float64]  # (K, 4) x1 y1 x2 y2 [px], the pixels' outer edges; NaN where there are none


def actor_regions(instance: NDArray[np.int32], count: int) -> Regions:
    """Return the regions of actors 0 to `count` - 1, which a camera's `instance` (H, W) shows as 1 to `count`."""
    return _regions(instance, count, 1)


def thing_regions(instance: NDArray[np.int32], count: int) -> Regions:
    """Return the regions of things 0 to `count` - 1, which a camera's `instance` (H, W) shows as -1 to -`count`."""
    return _regions(instance, count, -1)


def _regions(instance: NDArray[np.int32], count: int, sign: int) -> Regions:
    pixels = np.zeros(count + 1, np.int64)
    box = np.empty((count + 1, 4))
    box[:, :2], box[:, 2:] = np.inf, -np.inf
    _collect(instance, sign, pixels, box)
    box[pixels == 0] = np.nan
    return Regions(pixels[1:], box[1:] + OUTER_EDGES)


@compiled
def _collect(instance, sign, pixels, box):
    for v in range(instance.shape[0]):
        for u in range(instance.shape[1]):
            number = instance[v, u] * sign
            if number > 0:
                pixels[number] += 1
                box[number, 0] = min(box[number, 0], u)
                box[number, 1] = min(box[number, 1], v)
                box[number, 2] = max(box[number, 2], u)
                box[number, 3] = max(box[number, 3], v)
