"""Further rays for the pixels that one does not do justice, and the mean over them.

Pixels at edges get two more rays, which with the first stand as three rooks; pixels that a thin thing far away may
cross get eight more, as nine. So a pole covers as much of its pixels as it is wide, whether or not a pixel's centre
meets it.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.lens import Lens
from flcav.sensors.shading.edges import THIN
from flcav.world.materials import Material
from flcav.world.rays.compiled import compiled

SIGN = int(Material.SIGN)
ROOKS = np.float32(3)  # a further ray stands for so much narrower a part of its pixel
_THREE = np.array([(-1, 1), (1, -1)], np.float32) / 3
_NINE = np.array([(-4, -1), (-3, 2), (-2, -3), (-1, 4), (1, -4), (2, 3), (3, -2), (4, 1)], np.float32) / 9
BRIGHTEST = 3.0  # what outshines this after exposure counts no more: edges of lamps would stay jagged


def further_rays(
    rays: NDArray[np.float32], kind: NDArray[np.uint8], lens: Lens
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the further unit rays (S, 3) of the pixels that need some, and the pixel (S,) each belongs to."""
    total = int(np.bincount(kind, minlength=4) @ (0, len(_THREE), len(_NINE), len(_NINE)))
    directions, pixel = np.empty((total, 3), np.float32), np.empty(total, np.int32)
    _spread(rays, kind, lens.width, lens.height, _THREE, _NINE, directions, pixel)
    return directions, pixel


@compiled
def donors(hits, pixel, seen, first, material, width, out):
    """Write for each further ray the pixel `out` (S,) that shows the same face: its own or one beside it; else -1.

    What is drawn on faces is smooth over pixels, so that such a ray would see the same. Signs have none: their
    letters are finer. `first` and `material` are those of `Scene.surfaces`.
    """
    for sample in range(len(pixel)):
        out[sample] = -1
        own, instance, row = pixel[sample], hits.instance[sample], -1
        if instance >= 0:
            row = first[instance] + hits.face[sample]
            if material[row] == SIGN:
                continue
        for step in (0, -1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1):
            other = own + step
            if other >= 0 and other < len(seen.row) and seen.row[other] == row and seen.instance[other] == instance:
                out[sample] = other
                break


@compiled
def average(radiance, further, pixel, ceiling):
    """Replace the `radiance` of pixels by the mean with that of their `further` rays (S, 3), all below `ceiling`."""
    start = 0
    while start < len(pixel):
        own, end = pixel[start], start
        while end < len(pixel) and pixel[end] == own:
            end += 1
        for band in range(3):
            total = min(radiance[own, band], ceiling)
            for sample in range(start, end):
                total += min(further[sample, band], ceiling)
            radiance[own, band] = total / (end - start + 1)
        start = end


@compiled
def _spread(rays, kind, width, height, three, nine, directions, pixel):
    sample = 0
    for own in range(len(kind)):
        if kind[own] == 0:
            continue
        offsets = nine if kind[own] & THIN else three
        right = own + 1 if own % width + 1 < width else own - 1
        below = own + width if own + width < len(kind) else own - width
        sign_x, sign_y = np.float32(right - own), np.float32(1 if below > own else -1)
        a, b = rays[own, 0] / rays[own, 2], rays[own, 1] / rays[own, 2]
        a_x, b_x = (rays[right, 0] / rays[right, 2] - a) * sign_x, (rays[right, 1] / rays[right, 2] - b) * sign_x
        a_y, b_y = (rays[below, 0] / rays[below, 2] - a) * sign_y, (rays[below, 1] / rays[below, 2] - b) * sign_y
        for offset in offsets:
            x, y = a + offset[0] * a_x + offset[1] * a_y, b + offset[0] * b_x + offset[1] * b_y
            length = np.sqrt(x * x + y * y + 1)
            directions[sample, 0], directions[sample, 1], directions[sample, 2] = x / length, y / length, 1 / length
            pixel[sample] = own
            sample += 1
