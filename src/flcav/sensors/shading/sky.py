"""The sky."""

import numpy as np

from flcav.world.rays.compiled import compiled


@compiled
def sky_at(x, y, z, light):
    """Return the radiance of the sky in the unit direction x, y, z, world frame."""
    low = 1 - max(z, np.float32(0))
    low = low * low * low
    return (
        light.zenith[0] * (1 - low) + light.horizon[0] * low,
        light.zenith[1] * (1 - low) + light.horizon[1] * low,
        light.zenith[2] * (1 - low) + light.horizon[2] * low,
    )
