"""Which light is kept away: one ray from every surface seen to the light that matters most there."""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.shading.light import Light
from flcav.sensors.shading.state import Lamps, strongest
from flcav.sensors.shading.survey import Survey
from flcav.world.rays.compiled import compiled
from flcav.world.scene import Scene

SUN_REACH_M = 300.0
DARK = 1e-3  # a sun dimmer than this casts no shadow


def shadows(
    scene: Scene, seen: Survey, light: Light, lamps: Lamps, hidden: int | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return for each ray's end the lamp that casts its shadow (-1: the sun), and the share of that light there."""
    if light.lamps < 1:
        return np.full(len(seen), -1, np.int32), sun_shadows(scene, seen, light, hidden)
    key, far = np.full(len(seen), -1, np.int32), np.empty(len(seen), np.float32)
    towards = np.zeros((len(seen), 3), np.float32)
    strongest(seen, lamps, key, towards, far)
    return key, 1 - scene.blocked(seen.position, towards, far, hidden=hidden).astype(np.float32)


def sun_shadows(scene: Scene, seen: Survey, light: Light, hidden: int | None) -> NDArray[np.float32]:
    """Return for each ray's end whether the sun reaches it: 1, or 0 behind something; 1 too where it faces away."""
    far = np.empty(len(seen), np.float32)
    _facing(seen, light.to_sun, max(light.sun) > DARK, far)
    return 1 - scene.blocked(seen.position, np.array([light.to_sun]), far, hidden=hidden).astype(np.float32)


@compiled
def _facing(seen, to_sun, shines, far):
    for ray in range(len(far)):
        normal = seen.normal[ray]
        turned = normal[0] * to_sun[0] + normal[1] * to_sun[1] + normal[2] * to_sun[2]
        far[ray] = SUN_REACH_M if shines and seen.row[ray] >= 0 and turned > 0 else -1.0
