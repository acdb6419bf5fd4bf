"""Visibility of road users from a place among buildings and traffic, by ray casting."""

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.world.scene import Scene

Array = NDArray[np.float64]

FIELD_M = (51.2, 28.8)  # ahead, and to each side: the field of the vehicle's detector, `small`
EYE_M = 1.85  # of its LiDAR above the ground
ACROSS = (0.0, -0.4, 0.4)  # of a road user's extent across the line of sight: where rays end
START_M = 0.6  # from the place to the start of a ray, outside a mast


def share_seen(scene: Scene, place: Array, boxes: Boxes, hidden: int | None = None) -> Array:
    """Return (N,) the share of three rays from a place (3,) to each road user that nothing else is in the way of.

    A ray ends before the road user's own body. `hidden` is the row of an actor that is left out, such as the own one.
    """
    if not len(boxes):
        return np.zeros(0)
    sight = boxes.center - place
    flat = np.maximum(np.hypot(*sight[:, :2].T), 1e-6)
    aside = np.stack((-sight[:, 1], sight[:, 0], np.zeros(len(boxes))), axis=1) / flat[:, None]
    along = np.stack((np.cos(boxes.yaw), np.sin(boxes.yaw)), axis=1)
    cross = np.abs((along * aside[:, :2]).sum(axis=1))
    extent = boxes.size[:, 0] * cross + boxes.size[:, 1] * np.sqrt(np.maximum(1 - cross**2, 0))
    ends = boxes.center[:, None] + np.array(ACROSS)[:, None] * (extent[:, None] * aside)[:, None]  # (N, 3, 3)
    rays = ends - place
    length = np.linalg.norm(rays, axis=2)
    unit = (rays / np.maximum(length, 1e-9)[..., None]).reshape(-1, 3)
    body = np.hypot(*boxes.size[:, :2].T)[:, None] / 2
    far = np.maximum(length - START_M - body, 0.0).ravel()
    starts = place + START_M * unit
    blocked = scene.find_occluded(
        starts.astype(np.float32), unit.astype(np.float32), far.astype(np.float32), hidden=hidden
    )
    return 1 - blocked.reshape(len(boxes), len(ACROSS)).mean(axis=1)
