"""The radiance of surfaces: their colour under sun and sky, and the air between."""

import numpy as np

from flcav.sensors.shading.sky import sky_at
from flcav.world.rays.compiled import compiled


@compiled
def shade(survey, light, material, appearance, lit, radiance):
    """Write the `radiance` (N, 3) of what N rays met; `lit` (N,) is the share of the sun that reaches it."""
    for ray in range(len(lit)):
        row = survey.row[ray]
        if row < 0:
            red, green, blue = sky_at(survey.ray[ray, 0], survey.ray[ray, 1], survey.ray[ray, 2], light)
        else:
            albedo = appearance.colour[survey.instance[ray], material[row]]
            nx, ny, nz = survey.normal[ray, 0], survey.normal[ray, 1], survey.normal[ray, 2]
            sun = max(nx * light.to_sun[0] + ny * light.to_sun[1] + nz * light.to_sun[2], np.float32(0)) * lit[ray]
            up = np.float32(0.5) + np.float32(0.5) * nz
            kept = np.exp(-light.extinction * survey.distance[ray])
            red = albedo[0] * (sun * light.sun[0] + up * light.zenith[0] + np.float32(0.3) * light.horizon[0])
            green = albedo[1] * (sun * light.sun[1] + up * light.zenith[1] + np.float32(0.3) * light.horizon[1])
            blue = albedo[2] * (sun * light.sun[2] + up * light.zenith[2] + np.float32(0.3) * light.horizon[2])
            red = red * kept + light.air[0] * (1 - kept)
            green = green * kept + light.air[1] * (1 - kept)
            blue = blue * kept + light.air[2] * (1 - kept)
        radiance[ray, 0], radiance[ray, 1], radiance[ray, 2] = red, green, blue
