"""From radiance to bytes: exposure, a filmic curve and sRGB's, through one table."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.compiled import compiled
from flcav.seeds import stream

STEPS = 4096
GRAINS = 65521  # a prime, so that rows of a picture do not repeat


CONTRAST, SHOULDER = 1.25, 0.977
WHITE = 5.0  # exposed light that is shown as white: walls in the sun stay below
MIDDLE, MIDDLE_SHOWN = 0.15, 0.17


def _filmic(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what is shown, 0 to 1, of exposed light: Lottes, Optimization of HDR Color Pipelines, GDC 2016."""
    low, high = MIDDLE ** (CONTRAST * SHOULDER), WHITE ** (CONTRAST * SHOULDER)
    scale = (WHITE**CONTRAST * MIDDLE_SHOWN - MIDDLE**CONTRAST) / ((high - low) * MIDDLE_SHOWN)
    shift = (high * MIDDLE**CONTRAST - WHITE**CONTRAST * low * MIDDLE_SHOWN) / ((high - low) * MIDDLE_SHOWN)
    return np.minimum(light**CONTRAST / (light ** (CONTRAST * SHOULDER) * scale + shift), 1)


def _table() -> NDArray[np.float32]:
    share = (np.arange(STEPS) + 0.5) / STEPS
    shown = _filmic(share / (1 - share))  # the table runs over light / (1 + light)
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
