"""Image annotations of actors: visible pixels, visible and amodal boxes, truncation, occlusion."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import inverse
from flcav.machine.compiled import compiled
from flcav.sensors.frame import Array, Views
from flcav.sensors.labels.outlines import clip_boxes, compute_amodal_boxes, compute_truncation
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.world.scene import Scene

OUTER_EDGES = np.array((-0.5, -0.5, 0.5, 0.5))  # from the centres of the outermost pixels
SAMPLES = 4096  # pixels sampled of an amodal box for its occlusion, about; of larger ones every n-th row and column


class Regions(NamedTuple):
    """Pixel counts and bounding boxes of K instances in an image."""

    pixels: NDArray[np.int64]  # (K,) number of pixels
    box: NDArray[np.float64]  # (K, 4) x1 y1 x2 y2 [px], to the pixels' outer edges; NaN where there are none


def find_actor_regions(instance: NDArray[np.int32], count: int) -> Regions:
    """Return the regions of actors 0 to `count` - 1, whose values in the `instance` image (H, W) are 1 to `count`."""
    return _regions(instance, count, 1)


def find_thing_regions(instance: NDArray[np.int32], count: int) -> Regions:
    """Return the regions of things 0 to `count` - 1, whose values in the `instance` image (H, W) are -1 to -`count`."""
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


def view_actors(
    scene: Scene,
    world_from_camera: Array,
    lens: Lens,
    instance: NDArray[np.int32],
    regions: Regions,
    actors: NDArray[np.int64],
) -> Views:
    """Return the image annotations of `actors` (M,): 2-D boxes, pixels, truncation and occlusion.

    `instance` (H, W) is a + 1 at the scene's actor a, `regions` are those of all the scene's actors. The scene is at
    the instant of the image. Occlusion compares an image's pixels with rays cast at the actor alone.
    """
    box = compute_amodal_boxes(scene, world_from_camera, lens, actors)
    occlusion = np.ones(len(actors))
    inside = clip_boxes(box, lens)
    for row in np.flatnonzero(regions.pixels[actors]):  # the occlusion of the others is 1
        actor = int(actors[row])
        sampled = _sampled(inside[row])
        visible = np.count_nonzero(instance[np.ix_(*sampled)] == actor + 1)
        unoccluded = _unoccluded(scene, world_from_camera, lens, actor, sampled)
        if visible and unoccluded:
            occlusion[row] = 1 - min(visible / unoccluded, 1.0)
    return Views(
        amodal_box=box,
        visible_box=regions.box[actors],
        pixels=regions.pixels[actors],
        truncation=compute_truncation(box, lens),
        occlusion=occlusion,
    )


def _sampled(box: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and the columns of the pixels sampled for the occlusion of an actor with the `box` (4,)."""
    x1, y1, x2, y2 = box
    step = max(1, int(np.sqrt((x2 - x1) * (y2 - y1) / SAMPLES)))
    first_column, first_row = int(np.ceil(x1)), int(np.ceil(y1))
    return np.arange(first_row, int(np.floor(y2)) + 1, step), np.arange(first_column, int(np.floor(x2)) + 1, step)


def _unoccluded(
    scene: Scene,
    world_from_camera: Array,
    lens: Lens,
    actor: int,
    sampled: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> int:
    """Return the number of sampled pixels that show the actor in an empty world."""
    rows, columns = sampled
    rays = compute_pixel_rays(lens).reshape(lens.height, lens.width, 3)[np.ix_(rows, columns)].reshape(-1, 3)
    if not len(rays):
        return 0
    body_from_camera = inverse(scene.world_from_actor(actor)) @ world_from_camera
    hits = scene.cast_each(np.array([actor]), body_from_camera[None], np.array([len(rays)]), rays)
    return int(np.count_nonzero(hits.face >= 0))
