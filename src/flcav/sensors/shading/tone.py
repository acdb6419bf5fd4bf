"""From radiance to bytes: exposure, a filmic curve and sRGB's, through one table."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.seeds import stream
from flcav.world.rays.compiled import compiled

STEPS = 4096
GRAINS = 65521  # a prime, so that rows of a picture do not repeat


def _table() -> np.ndarray:
    share = (np.arange(STEPS) + 0.5) / STEPS
    light = share / (1 - share)  # the table runs over light / (1 + light)
    filmic = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)  # Narkowicz 2015, of ACES
    shown = np.clip(filmic, 0, 1)
    return (255 * np.where(shown < 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)).astype(np.float32)


TABLE = _table()


@lru_cache(maxsize=1)
def grain() -> NDArray[np.float32]:
    """Return GRAINS numbers from the normal distribution: a sensor's noise, taken from a random place on."""
    return stream(0, "grain").standard_normal(GRAINS, np.float32)


@compiled
def develop(radiance, exposure, grain, shift, noise, out):
    """Write the bytes `out` (N, 3) of `radiance` (N, 3), with noise of that standard deviation."""
    number = shift
    for pixel in range(len(radiance)):
        for band in range(3):
            light = max(radiance[pixel, band] * exposure, np.float32(0))
            value = TABLE[int(light / (np.float32(1) + light) * np.float32(STEPS - 0.01))]
            number = number + 1 if number + 1 < GRAINS else 0
            value += noise * grain[number] + np.float32(0.5)
            out[pixel, band] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))
