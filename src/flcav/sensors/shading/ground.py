"""Asphalt, paving and grass: factors of their mean colour, and what is painted on the road."""

import numpy as np

from flcav.sensors.shading.noise import fade, hashed, noise_at, overlap
from flcav.world.rays.compiled import inlined

SLAB_M = 0.5
JOINT_M = 0.012


@inlined
def asphalt(x, y, footprint, table):
    """Return the brightness of asphalt over its mean: grain, stains, old and new stretches, sealed cracks."""
    broad = noise_at(table, x * 0.9, y * 0.9)
    patch = noise_at(table, x * 0.11 + 40.0, y * 0.11)
    tone = np.float32(0.68) + np.float32(0.30) * broad + np.float32(0.40) * patch
    middle = fade(np.float32(0.12), footprint)
    if middle > 0:
        tone += middle * np.float32(0.30) * (noise_at(table, x * 9.0, y * 9.0) - np.float32(0.5))
        crack = abs(noise_at(table, x * 0.55 + 90.0, y * 0.55 + 17.0) - np.float32(0.5))
        if crack < np.float32(0.006) and patch > np.float32(0.45):
            tone -= middle * np.float32(0.35)
    fine = fade(np.float32(0.022), footprint)
    if fine > 0:
        tone += fine * np.float32(0.55) * (noise_at(table, x * 71.0, y * 71.0) - np.float32(0.5))
    return tone


@inlined
def paving(x, y, footprint, table):
    """Return the brightness of a pavement of slabs over its mean."""
    i, j = int(np.floor(x / SLAB_M)), int(np.floor(y / SLAB_M))
    tone = np.float32(0.86) + np.float32(0.24) * noise_at(table, x * 0.5, y * 0.5)
    near = fade(np.float32(0.5), footprint)
    if near > 0:
        tone += near * np.float32(0.16) * (hashed(i, j) - np.float32(0.5))
        u, v = np.float32(x - (i + 0.5) * SLAB_M), np.float32(y - (j + 0.5) * SLAB_M)
        half = np.float32(SLAB_M / 2 - JOINT_M / 2)
        width = max(footprint, np.float32(0.004))
        inside = overlap(u, half, width) * overlap(v, half, width)
        tone *= 1 - near * np.float32(0.55) * (1 - inside)
        fine = fade(np.float32(0.03), footprint)
        if fine > 0:
            tone += fine * np.float32(0.16) * (noise_at(table, x * 45.0, y * 45.0) - np.float32(0.5))
    return tone


@inlined
def grass(x, y, footprint, table):
    """Return the brightness of grass over its mean, and how dry it is, 0 to 1."""
    dry = noise_at(table, x * 0.07, y * 0.07)
    tone = np.float32(0.55) + np.float32(0.6) * noise_at(table, x * 0.8, y * 0.8)
    near = fade(np.float32(0.10), footprint)
    if near > 0:
        tone += near * np.float32(0.7) * (noise_at(table, x * 16.0, y * 16.0) - np.float32(0.5))
    fine = fade(np.float32(0.02), footprint)
    if fine > 0:
        tone += fine * np.float32(0.7) * (noise_at(table, x * 61.0, y * 43.0) - np.float32(0.5))
    return max(tone, np.float32(0.1)), dry
