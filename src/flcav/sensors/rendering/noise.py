"""Procedural noise: a periodic table of fractal noise, hashes of lattice points, and box-filter coverage."""

from functools import lru_cache

import numpy as np

from flcav.arrays import Array32
from flcav.machine.compiled import inlined
from flcav.statistics.streams import stream

SIDE = 256  # cells per side of a table, a power of two


@lru_cache(maxsize=1)
def make_noise() -> Array32:
    """Return a table (SIDE, SIDE) of periodic fractal noise with a power-law spectrum, uniform in [0, 1]."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.rfftfreq(SIDE), indexing="ij")) * SIDE
    amplitude = np.where(frequency > 0, np.maximum(frequency, 2.0) ** -1.7, 0.0)
    phase = np.exp(2j * np.pi * stream(0, "noise").random(frequency.shape))
    field = np.fft.irfft2(amplitude * phase, s=(SIDE, SIDE))
    rank = field.ravel().argsort().argsort().reshape(SIDE, SIDE)  # histogram equalisation
    return (rank / rank.max()).astype(np.float32)


@inlined
def sample_noise(table, x, y):
    """Interpolate a periodic table bilinearly at x, y [cells]."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = np.float32(x - i), np.float32(y - j)
    i0, i1, j0, j1 = i & (SIDE - 1), (i + 1) & (SIDE - 1), j & (SIDE - 1), (j + 1) & (SIDE - 1)
    low = table[i0, j0] + u * (table[i1, j0] - table[i0, j0])
    high = table[i0, j1] + u * (table[i1, j1] - table[i0, j1])
    return low + v * (high - low)


@inlined
def hash_pair(a, b):
    """Return a hash of the integers a and b as a number in [0, 1)."""
    word = np.uint32((a * 374761393 + b * 668265263) & 0xFFFFFFFF)
    word = np.uint32(((word ^ (word >> np.uint32(13))) * np.uint64(1274126177)) & np.uint64(0xFFFFFFFF))
    return np.float32((word ^ (word >> np.uint32(16))) & np.uint32(0xFFFFFF)) / np.float32(16777216.0)


@inlined
def fade(scale, footprint):
    """Return the contrast, 1 to 0, of a texture of `scale` [m] in a pixel of width `footprint` [m] (anti-aliasing)."""
    return min(max(np.float32(1.5) - footprint / scale, np.float32(0)), np.float32(1))


@inlined
def overlap(distance, half, width):
    """Return the share of an interval of `width` around `distance` that is between -`half` and `half`."""
    inside = min(distance + 0.5 * width, half) - max(distance - 0.5 * width, -half)
    return max(inside, np.float32(0)) / width
