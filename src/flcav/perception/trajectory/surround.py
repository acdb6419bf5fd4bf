"""What an agent's cameras see around a road user: small pictures, and how its ground projects into them."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.geometry import inverse, pose
from flcav.perception.images import Picture, checked_picture, resized
from flcav.perception.trajectory.config import CrossView

Array = NDArray[np.float64]

CAMERAS = 6  # around a vehicle, as a rule
KEPT_BYTES = 2**30  # of pictures at hand

Pictured = tuple[NDArray[np.uint8], Array, Array]  # pictures, intrinsics and views, without the road user


class Surround(NamedTuple):
    """The pictures of n cameras around a road user at one instant."""

    pictures: NDArray[np.uint8]  # (n, height, width, 3)
    intrinsics: Array  # (n, 3, 3) of the pictures as they are here [px]
    camera_from_frame: Array  # (n, 4, 4) from the road user's frame to the optical one: x right, y down, z forward


def surround(data: Dataset, number: int, present: Array, settings: CrossView) -> Surround:
    """Return what the cameras of frame `number` see, as the agent believes them to be, around `present` x, y, yaw."""
    pictures, intrinsics, camera_from_world = _kept(settings)(data, number)
    world_from_frame = pose(float(present[0]), float(present[1]), yaw=float(present[2]))
    return Surround(pictures, intrinsics, camera_from_world @ world_from_frame)


@lru_cache(maxsize=2)
def _kept(settings: CrossView) -> Callable[[Dataset, int], Pictured]:
    """Return `_read` that keeps the frames read last, as many as fit into `KEPT_BYTES`."""
    frame_bytes = CAMERAS * settings.height_px * settings.width_px * 3
    return lru_cache(maxsize=KEPT_BYTES // frame_bytes)(partial(_read, settings))


def _read(settings: CrossView, data: Dataset, number: int) -> Pictured:
    frame = data.frame(number)
    pictures, intrinsics, views = [], [], []
    for camera in data.cameras(number):
        rgb = checked_picture(data.plane(number, camera, "rgb"), f"{data.folder} {frame.key}/{camera}")
        pictures.append(resized(rgb, settings.width_px, settings.height_px))
        intrinsics.append(rescaled(frame.assumed.intrinsics[camera], rgb, settings))
        views.append(inverse(frame.assumed_world_from_sensor(camera)))
    return np.stack(pictures), np.stack(intrinsics), np.stack(views)


def rescaled(intrinsics: Array, rgb: Picture, settings: CrossView) -> Array:
    """Return the (3, 3) intrinsics of the picture resized; the centre of a picture's first pixel is at (0, 0)."""
    scale = np.array((settings.width_px / rgb.shape[1], settings.height_px / rgb.shape[0]))
    out = intrinsics.copy()
    out[:2] *= scale[:, None]
    out[:2, 2] += (scale - 1) / 2
    return out
