"""CARLA's cameras: images of blue, green, red and alpha, row after row from the top.

Depth is coded in 24 bits from red to blue, of 1000 m, along the optical axis. The semantic tag is red; an instance
image adds the two lower bytes of the actor's number as green and blue.
"""

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.Image import Resampling

from flcav.carla.server.sensing.sight import THREADS, Sensor, Sight, lens_of
from flcav.carla.server.wire import pack_image
from flcav.machine.compiled import compiled
from flcav.sensors.lens import BODY_FROM_OPTICAL, compute_pixel_rays

FAR_M = 1000.0
DEPTH_STEPS = 2**24 - 1


def sense_rgb(sight: Sight, sensor: Sensor) -> bytes:
    """Return a colour image."""
    rgb, lens = sight.photograph(sensor).rgb, lens_of(sensor)
    if rgb.shape[:2] != (lens.height, lens.width):  # of low quality
        rgb = np.asarray(Image.fromarray(rgb).resize((lens.width, lens.height), Resampling.BILINEAR))
    image = np.empty((*rgb.shape[:2], 4), np.uint8)
    _write_colours(rgb, image)
    return _pack(sensor, image)


def sense_depth(sight: Sight, sensor: Sensor) -> bytes:
    """Return a depth image."""
    lens = lens_of(sensor)
    rays = compute_pixel_rays(lens)
    pose = sensor.pose @ BODY_FROM_OPTICAL
    hits = sight.scene.cast(pose, rays, far_m=FAR_M, hidden=sight.find_inside(sensor), threads=THREADS)
    image = np.empty((lens.height, lens.width, 4), np.uint8)
    _write_depths(hits.distance, rays, image.reshape(-1, 4))
    return _pack(sensor, image)


def sense_semantic(sight: Sight, sensor: Sensor) -> bytes:
    """Return an image of semantic tags."""
    tags, instance = sight.label(sensor)
    return _pack(sensor, _draw_labels(tags, instance, np.zeros(len(sight.actors), np.uint32)))


def sense_instance(sight: Sight, sensor: Sensor) -> bytes:
    """Return an image of semantic tags and actors."""
    return _pack(sensor, _draw_labels(*sight.label(sensor), sight.actors))


def _draw_labels(tags: NDArray[np.uint8], instance: NDArray[np.int32], actors: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Return an image of tags (H, W), with the numbers of the trace's `actors` (A,) where they are seen."""
    image = np.empty((*tags.shape, 4), np.uint8)
    _write_labels(tags, instance, np.append(np.uint32(0), actors), image)
    return image


def _pack(sensor: Sensor, image: NDArray[np.uint8]) -> bytes:
    return pack_image(image.shape[1], image.shape[0], sensor.number_of("fov"), image)


@compiled
def _write_colours(rgb, image):
    for row in range(len(image)):
        for column in range(image.shape[1]):
            image[row, column, 0], image[row, column, 1] = rgb[row, column, 2], rgb[row, column, 1]
            image[row, column, 2], image[row, column, 3] = rgb[row, column, 0], 255


@compiled
def _write_depths(distance, rays, image):
    for pixel in range(len(image)):
        share = min(distance[pixel] * rays[pixel, 2] / np.float32(FAR_M), np.float32(1))
        code = np.uint32(np.float64(share) * DEPTH_STEPS)
        image[pixel, 0], image[pixel, 1], image[pixel, 2] = code >> 16 & 255, code >> 8 & 255, code & 255
        image[pixel, 3] = 255


@compiled
def _write_labels(tags, instance, numbers, image):
    for row in range(len(image)):
        for column in range(image.shape[1]):
            number = numbers[max(instance[row, column], 0)]
            image[row, column, 0], image[row, column, 1] = number >> 8 & 255, number & 255
            image[row, column, 2], image[row, column, 3] = tags[row, column], 255
