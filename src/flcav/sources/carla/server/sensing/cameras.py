"""CARLA's cameras: images of blue, green, red and alpha, row after row from the top.

Depth is coded in 24 bits from red to blue, of 1000 m, along the optical axis. The semantic tag is red; an instance
image adds the two lower bytes of the actor's number as green and blue.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.frame import SEMANTICS
from flcav.sensors.lens import BODY_FROM_OPTICAL, compute_pixel_rays
from flcav.sources.carla.server.sensing.sight import THREADS, Sensor, Sight, lens_of
from flcav.sources.carla.server.wire import pack_image

FAR_M = 1000.0
DEPTH_STEPS = 2**24 - 1


def sense_rgb(sight: Sight, sensor: Sensor) -> bytes:
    """Return a colour image."""
    rgb = sight.photograph(sensor).rgb
    return _pack(sensor, rgb[..., 2], rgb[..., 1], rgb[..., 0])


def sense_depth(sight: Sight, sensor: Sensor) -> bytes:
    """Return a depth image."""
    lens = lens_of(sensor)
    rays = compute_pixel_rays(lens)
    pose = sensor.pose @ BODY_FROM_OPTICAL
    hits = sight.scene.cast(pose, rays, far_m=FAR_M, hidden=sight.find_inside(sensor), threads=THREADS)
    depth = np.minimum(hits.distance * rays[:, 2] / np.float32(FAR_M), np.float32(1))
    code = (depth.astype(np.float64) * DEPTH_STEPS).astype(np.uint32).reshape(lens.height, lens.width)
    return _pack(sensor, code >> 16 & 255, code >> 8 & 255, code & 255)


def sense_semantic(sight: Sight, sensor: Sensor) -> bytes:
    """Return an image of semantic tags."""
    tags, _ = sight.label(sensor)
    return _pack(sensor, 0, 0, tags)


def sense_instance(sight: Sight, sensor: Sensor) -> bytes:
    """Return an image of semantic tags and actors."""
    tags, instance = sight.label(sensor)
    number = np.append(np.uint32(0), sight.actors)[np.maximum(instance, 0)]
    number = np.where(tags == SEMANTICS["sky"], 0, number)
    return _pack(sensor, number >> 8 & 255, number & 255, tags)


def _pack(sensor: Sensor, blue: NDArray | int, green: NDArray | int, red: NDArray) -> bytes:
    image = np.full((*red.shape, 4), 255, np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = blue, green, red
    return pack_image(red.shape[1], red.shape[0], sensor.number_of("fov"), image)
