"""Random mirrorings, turns and scales of a whole sample: the global augmentations of SECOND, sec. 3.2.1."""

from dataclasses import replace

import numpy as np

from flcav.geometry import Boxes
from flcav.perception.objects.config import Augmentation
from flcav.perception.objects.samples import Sample


def augment(sample: Sample, how: Augmentation, rng: np.random.Generator) -> Sample:
    """Return the sample flipped, turned and scaled about the sensor by random amounts drawn from `rng`."""
    mirror = -1.0 if how.flip and rng.random() < 0.5 else 1.0
    turn = rng.uniform(-how.turn_rad, how.turn_rad)
    scale = rng.uniform(1 - how.scale, 1 + how.scale)
    return transformed(sample, mirror, turn, scale)


def transformed(sample: Sample, mirror: float, turn_rad: float, scale: float) -> Sample:
    """Return the sample with y times `mirror` (1 or -1), turned counter-clockwise, then scaled."""
    cos, sin = np.cos(turn_rad) * scale, np.sin(turn_rad) * scale
    plane = np.array([[cos, sin], [-mirror * sin, mirror * cos]])  # right factor of rows (x, y)
    points = sample.points.copy()
    points[:, :2] = points[:, :2] @ plane.astype(np.float32)
    points[:, 2] *= np.float32(scale)

    def moved(boxes: Boxes) -> Boxes:
        center = np.concatenate((boxes.center[:, :2] @ plane, boxes.center[:, 2:] * scale), 1)
        return replace(boxes, center=center, size=boxes.size * scale, yaw=boxes.yaw * mirror + turn_rad)

    free = None if sample.free is None else (sample.free @ plane).astype(np.float32)
    return Sample(points, moved(sample.boxes), moved(sample.ignore), free, sample.exact)
