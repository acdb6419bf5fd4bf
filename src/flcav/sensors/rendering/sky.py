"""Radiance of the sky: sun, clouds and air, what surfaces mirror of it, and a distant skyline."""

import numpy as np

from flcav.machine.compiled import inlined
from flcav.sensors.rendering.noise import hash_pair, sample_noise

SKYLINE = 0.16  # sine of the elevation up to which houses hide the sky in reflections
TOP_OF_FOG_M = 500.0  # height of the fog layer


@inlined
def compute_clear_sky(x, y, z, light):
    """Return red, green, blue of the sky without clouds and solar disc in the unit direction x, y, z, world frame."""
    low = 1 - max(z, np.float32(0))
    low = low * low * low
    low *= low * np.float32(0.55) + np.float32(0.45)
    red = light.zenith[0] * (1 - low) + light.horizon[0] * low
    green = light.zenith[1] * (1 - low) + light.horizon[1] * low
    blue = light.zenith[2] * (1 - low) + light.horizon[2] * low
    off_sun = 1 - (x * light.to_sun[0] + y * light.to_sun[1] + z * light.to_sun[2])
    if off_sun < np.float32(0.6):
        halo = np.float32(0.012) / (off_sun + np.float32(0.012)) * np.float32(0.16) * (1 - off_sun / np.float32(0.6))
        red += halo * light.sun[0]
        green += halo * light.sun[1]
        blue += halo * light.sun[2]
    return red, green, blue


@inlined
def add_clouds(red, green, blue, x, y, z, light, table):
    """Return a sky's red, green, blue behind its clouds in the unit direction x, y, z, and the share that is clear."""
    clear = np.float32(1)
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
        clear = 1 - thick
    return red, green, blue, clear


@inlined
def compute_sky(x, y, z, light, table):
    """Return red, green, blue of a ray that hits nothing, in the unit direction x, y, z: sky, sun, clouds and air."""
    red, green, blue = compute_clear_sky(x, y, z, light)
    cosine = x * light.to_sun[0] + y * light.to_sun[1] + z * light.to_sun[2]
    sun = min(max((cosine - np.float32(0.99992)) / np.float32(0.00004), np.float32(0)), np.float32(1)) * np.float32(30)
    red, green, blue, clear = add_clouds(red, green, blue, x, y, z, light, table)
    sun *= clear
    red += sun * light.sun[0]
    green += sun * light.sun[1]
    blue += sun * light.sun[2]
    hidden = 1 - np.exp(-np.float32(light.extinction) * TOP_OF_FOG_M / (max(z, np.float32(0)) + np.float32(0.06)))
    red += hidden * (light.air[0] - red)
    green += hidden * (light.air[1] - green)
    blue += hidden * (light.air[2] - blue)
    return red, green, blue


@inlined
def compute_environment(x, y, z, light, table, cloudy):
    """Return red, green, blue of the environment map in the unit direction x, y, z: sky, dim houses, ground.

    `cloudy`: the sky has its clouds, as in the picture.
    """
    red, green, blue = compute_clear_sky(x, y, abs(z), light)
    if cloudy and z > 0:
        red, green, blue, _ = add_clouds(red, green, blue, x, y, z, light, table)
    height = np.float32(SKYLINE) * (np.float32(0.4) + np.float32(1.2) * sample_noise(table, x * 9.0, y * 9.0))
    above = min(max((z - height) * np.float32(25), np.float32(0)), np.float32(1))
    level = min(max(z * np.float32(25), np.float32(0)), np.float32(1))  # houses above, ground below the horizon
    dim = np.float32(1) + np.float32(0.7) * level
    red = dim * light.bounce[0] + above * (red - dim * light.bounce[0])
    green = dim * light.bounce[1] + above * (green - dim * light.bounce[1])
    blue = dim * light.bounce[2] + above * (blue - dim * light.bounce[2])
    return red, green, blue


HILLS, HOUSES = 0.030, 0.036  # sines of the greatest elevations of the skyline's hills and houses
LOTS = 64.0  # houses of the skyline per radian of azimuth, half of which are gaps
FAR_OFF_M = 900.0  # distance of the skyline, for the haze in front of it


@inlined
def add_skyline(red, green, blue, x, y, z, pixel_angle, light, table):
    """Return a sky's red, green, blue behind distant hills and houses in the unit direction x, y, z.

    `pixel_angle` [rad] is the angle over which their outlines are softened.
    """
    if z > np.float32(HILLS + HOUSES):
        return red, green, blue
    level = max(np.sqrt(x * x + y * y), np.float32(1e-6))
    u, v = x / level, y / level
    rough = sample_noise(table, u * 90.0, v * 90.0)
    hill = np.float32(HILLS) * (np.float32(0.2) + np.float32(0.7) * sample_noise(table, u * 6.0 + 9.0, v * 6.0))
    hill += np.float32(0.1 * HILLS) * rough
    along = np.float32(np.arctan2(v, u)) * np.float32(LOTS)
    lot = int(np.floor(along))
    tall = _rise(lot)
    beside = max(pixel_angle * np.float32(LOTS), np.float32(1e-3))
    nearer = max(1 - (along - lot) / beside, np.float32(0))  # softens the side of a house over a pixel
    tall += np.float32(0.5) * min(nearer, np.float32(1)) * (_rise(lot - 1) - tall)
    kept = np.exp(-np.float32(light.extinction) * np.float32(FAR_OFF_M)) * np.float32(0.6)
    for layer in range(2):
        top, tone = (hill, np.float32(0.55)) if layer == 0 else (tall, np.float32(1.1))
        share = min(max((top - z) / pixel_angle + np.float32(0.5), np.float32(0)), np.float32(1))
        red += share * (light.air[0] + kept * (tone * light.bounce[0] - light.air[0]) - red)
        green += share * (light.air[1] + kept * (tone * light.bounce[1] - light.air[1]) - green)
        blue += share * (light.air[2] + kept * (tone * light.bounce[2] - light.air[2]) - blue)
    return red, green, blue


@inlined
def _rise(lot):
    """Return the sine of the elevation of the skyline's house on a lot; below the horizon for a gap."""
    tall = np.float32(HOUSES) * (2 * hash_pair(lot, 3) - 1)
    return tall if tall < 0 else np.float32(0.3 * HOUSES) + np.float32(0.7) * tall
