"""Which light arrives: one ray from every surface seen to the sun, or to the lamp that matters most there."""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.shading.light import Light
from flcav.sensors.shading.state import Lamps, light_up
from flcav.sensors.shading.survey import Survey
from flcav.world.rays.compiled import compiled
from flcav.world.scene import Scene

SUN_REACH_M = 300.0
DARK = 1e-3  # a sun dimmer than this casts no shadow
SAME = 0.04  # pixels that differ by less of their distance lie on one surface


def lamp_light_on(scene: Scene, seen: Survey, lamps: Lamps, hidden: int | None) -> NDArray[np.float32]:
    """Return (N, 3) what lamps throw on each ray's end; the strongest one there casts shadows, the others none."""
    light, most, towards = (np.zeros((len(seen), 3), np.float32) for _ in range(3))
    far = np.empty(len(seen), np.float32)
    light_up(seen, lamps, light, most, towards, far)
    _add_where_free(light, most, scene.blocked(seen.position, towards, far, hidden=hidden))
    return light


def sunlit(scene: Scene, seen: Survey, light: Light, hidden: int | None) -> NDArray[np.float32]:
    """Return for each ray's end whether the sun reaches it: 1, or 0 behind something; 1 too where it faces away."""
    far = np.empty(len(seen), np.float32)
    _facing(seen, light.to_sun, max(light.sun) > DARK, far)
    return (
        (~scene.blocked(seen.position, np.array([light.to_sun]), far, hidden=hidden)).view(np.uint8).astype(np.float32)
    )


def soften(lit: NDArray[np.float32], seen: Survey, width: int) -> NDArray[np.float32]:
    """Return `lit` (N,), a picture's row after row, with edges of shadows as soft as a sun that is no point makes them.

    Means over three by three pixels (weights 1, 2, 1 each way) of what lies as far away.
    """
    out = np.empty_like(lit)
    _soften(lit, seen.distance, width, out)
    return out


@compiled
def _facing(seen, to_sun, shines, far):
    for ray in range(len(far)):
        normal = seen.normal[ray]
        turned = normal[0] * to_sun[0] + normal[1] * to_sun[1] + normal[2] * to_sun[2]
        far[ray] = SUN_REACH_M if shines and seen.row[ray] >= 0 and turned > 0 else -1.0


@compiled
def _add_where_free(light, most, blocked):
    for ray in range(len(blocked)):
        if not blocked[ray]:
            for band in range(3):
                light[ray, band] += most[ray, band]


@compiled
def _soften(lit, distance, width, out):
    count = len(lit)
    for pixel in range(count):
        own, column = lit[pixel], pixel % width
        out[pixel] = own
        if column == 0 or column == width - 1 or pixel < width or pixel >= count - width:
            continue
        if lit[pixel - 1] == own and lit[pixel + 1] == own and lit[pixel - width] == own and lit[pixel + width] == own:
            continue
        total, weight, near = np.float32(0), np.float32(0), np.float32(SAME) * distance[pixel]
        for down in range(-1, 2):
            for right in range(-1, 2):
                other = pixel + down * width + right
                if abs(distance[other] - distance[pixel]) <= near:
                    share = np.float32((2 - abs(down)) * (2 - abs(right)))
                    total += share * lit[other]
                    weight += share
        if weight > 0:
            out[pixel] = total / weight
