"""Tone mapping: exposure, a filmic curve and the sRGB transfer function, by one look-up table; sensor noise."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled
from flcav.statistics.streams import stream

STEPS = 4096  # entries of the look-up table
GRAINS = 65521  # length of the noise table: a prime, so that it does not repeat from row to row


CONTRAST, SHOULDER = 1.25, 0.977  # a and d of Lottes' curve
WHITE = 5.0  # exposed light that maps to white: sunlit walls stay below
MIDDLE, MIDDLE_SHOWN = 0.15, 0.17  # middle grey, and the value it maps to


def _filmic(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tone-mapped value, 0 to 1, of exposed light: Lottes, Optimization of HDR Color Pipelines, GDC 2016."""
    low, high = MIDDLE ** (CONTRAST * SHOULDER), WHITE ** (CONTRAST * SHOULDER)
    scale = (WHITE**CONTRAST * MIDDLE_SHOWN - MIDDLE**CONTRAST) / ((high - low) * MIDDLE_SHOWN)
    shift = (high * MIDDLE**CONTRAST - WHITE**CONTRAST * low * MIDDLE_SHOWN) / ((high - low) * MIDDLE_SHOWN)
    return np.minimum(light**CONTRAST / (light ** (CONTRAST * SHOULDER) * scale + shift), 1)


def _table() -> NDArray[np.float32]:
    share = (np.arange(STEPS) + 0.5) / STEPS
    shown = _filmic(share / (1 - share))  # the table is indexed by light / (1 + light)
    return (255 * np.where(shown < 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)).astype(np.float32)


TABLE = _table()


@lru_cache(maxsize=1)
def grain() -> NDArray[np.float32]:
    """Return the noise table: (GRAINS,) standard normal numbers, always the same, read from a random index on."""
    return stream(0, "grain").standard_normal(GRAINS, np.float32)


@compiled
def develop(radiance, exposure, grain, shift, noise, out):
    """Tone-map `radiance` (N, 3) into sRGB bytes `out` (N, 3).

    `exposure` is a factor of the radiance; `noise` is the standard deviation of the noise in bytes, read from the table
    `grain` (GRAINS,), from index `shift` on.
    """
    number = shift % GRAINS
    for pixel in range(len(radiance)):
        for band in range(3):
            light = max(radiance[pixel, band] * exposure, np.float32(0))
            value = TABLE[int(light / (np.float32(1) + light) * np.float32(STEPS - 0.01))]
            rise = np.float32(0.5)
            if noise > 0:
                number = number + 1 if number + 1 < GRAINS else 0
                rise = noise * grain[number] + np.float32(0.5)
            value += rise
            out[pixel, band] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))
