"""Radiance of the sky with sun and clouds, and an environment map of a street for mirror reflections."""

import numpy as np

from flcav.machine.compiled import inlined
from flcav.sensors.rendering.noise import sample_noise

SKYLINE = 0.16  # sine of the elevation up to which houses hide the sky, in reflections
TOP_OF_FOG_M = 500.0  # height of the layer of fog


@inlined
def compute_clear_sky(x, y, z, light):
    """Return red, green, blue of the sky without clouds or sun's disc, in the unit direction x, y, z, world frame."""
    low = 1 - max(z, np.float32(0))
    low = low * low * low
    low *= low * np.float32(0.55) + np.float32(0.45)
    red = light.zenith[0] * (1 - low) + light.horizon[0] * low
    green = light.zenith[1] * (1 - low) + light.horizon[1] * low
    blue = light.zenith[2] * (1 - low) + light.horizon[2] * low
    beside = 1 - (x * light.to_sun[0] + y * light.to_sun[1] + z * light.to_sun[2])
    if beside < np.float32(0.6):
        halo = np.float32(0.012) / (beside + np.float32(0.012)) * np.float32(0.16) * (1 - beside / np.float32(0.6))
        red += halo * light.sun[0]
        green += halo * light.sun[1]
        blue += halo * light.sun[2]
    return red, green, blue


@inlined
def compute_sky(x, y, z, light, table):
    """Return red, green, blue of a ray that hits nothing: sky, sun, clouds, and the air in between."""
    red, green, blue = compute_clear_sky(x, y, z, light)
    beside = x * light.to_sun[0] + y * light.to_sun[1] + z * light.to_sun[2]
    sun = min(max((beside - np.float32(0.99992)) / np.float32(0.00004), np.float32(0)), np.float32(1)) * np.float32(30)
    if z > np.float32(0.01) and light.cover > 0.02:
        far = 1 / (z + np.float32(0.06))
        u, v = x * far * np.float32(16), y * far * np.float32(16)
        shape = sample_noise(table, u, v) * np.float32(0.72) + sample_noise(
            table, u * 4.1 + 31.0, v * 4.1
        ) * np.float32(0.28)
        edge = np.float32(0.86 - 0.80 * light.cover)
        thick = min(max((shape - edge) / np.float32(0.22), np.float32(0)), np.float32(1))
        thick *= min(z * 9, np.float32(1))
        lit = sample_noise(table, u + light.to_sun[0] * 2.2, v + light.to_sun[1] * 2.2)
        bright = np.float32(0.72) + np.float32(0.62) * max(np.float32(0), 1 - thick * np.float32(0.55)) * (
            1 - lit * np.float32(0.5)
        )
        red += thick * (light.cloud[0] * bright - red)
        green += thick * (light.cloud[1] * bright - green)
        blue += thick * (light.cloud[2] * bright - blue)
        sun *= 1 - thick
    red += sun * light.sun[0]
    green += sun * light.sun[1]
    blue += sun * light.sun[2]
    hidden = 1 - np.exp(-np.float32(light.extinction) * TOP_OF_FOG_M / (max(z, np.float32(0)) + np.float32(0.06)))
    red += hidden * (light.air[0] - red)
    green += hidden * (light.air[1] - green)
    blue += hidden * (light.air[2] - blue)
    return red, green, blue


@inlined
def compute_environment(x, y, z, light, table):
    """Return red, green, blue of the environment of a mirror in the unit direction x, y, z: sky, dim houses, ground."""
    red, green, blue = compute_clear_sky(x, y, abs(z), light)
    height = np.float32(SKYLINE) * (np.float32(0.4) + np.float32(1.2) * sample_noise(table, x * 9.0, y * 9.0))
    above = min(max((z - height) * np.float32(25), np.float32(0)), np.float32(1))
    level = min(max(z * np.float32(25), np.float32(0)), np.float32(1))  # houses above, ground below the horizon
    dim = np.float32(1) + np.float32(0.7) * level
    red = dim * light.bounce[0] + above * (red - dim * light.bounce[0])
    green = dim * light.bounce[1] + above * (green - dim * light.bounce[1])
    blue = dim * light.bounce[2] + above * (blue - dim * light.bounce[2])
    return red, green, blue
