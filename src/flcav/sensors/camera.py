"""A colour camera: deferred shading of what its rays meet, and the truth about every pixel from the same rays."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.lens import Lens, directions
from flcav.sensors.shading.appearance import SEMANTICS, Appearance, appearance_of
from flcav.sensors.shading.light import light_of
from flcav.sensors.shading.shadows import shadows
from flcav.sensors.shading.state import lamps_of, state_of
from flcav.sensors.shading.surface import shade
from flcav.sensors.shading.survey import Survey, survey
from flcav.sensors.shading.tone import develop
from flcav.world.rays.compiled import compiled
from flcav.world.scene import Scene
from flcav.world.weather import Weather

FAR_M = 1000.0


class Camera(Lens):
    """What a camera is built like; its pose is the rig's."""


class Exposure(NamedTuple):
    """One image and the truth about its pixels, each from the ray through the pixel's centre."""

    rgb: NDArray[np.uint8]  # (H, W, 3) sRGB
    depth_m: NDArray[np.float32]  # (H, W) along the optical axis; inf for the sky
    semantic: NDArray[np.uint8]  # (H, W) one of SEMANTICS
    instance: NDArray[np.int32]  # (H, W) 0 none, a + 1 = the trace's actor a, -(t + 1) = thing t of `town_things`


def photograph(
    scene: Scene,
    world_from_camera: NDArray[np.float64],
    camera: Camera,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None = None,
) -> Exposure:
    """Return the image at the scene's instant, as if the actor `hidden` (the carrier) were not there.

    `world_from_camera` (4, 4) places the optical frame (x right, y down, z forward): for a sensor mounted by body axes
    it is `world_from_sensor @ BODY_FROM_OPTICAL`. The same arguments, and the same state of `rng`, give the same bytes.
    """
    rays = directions(camera)
    appearance, light = appearance_of(scene), light_of(weather)
    state = state_of(scene, light.lamps, low_sight=light.extinction > 0.002)
    lamps = lamps_of(scene, state)
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=hidden)
    seen = survey(scene, appearance, world_from_camera, rays, hits)
    key, lit = shadows(scene, seen, light, lamps, hidden)
    open_sky = np.ones(len(rays), np.float32)
    radiance, painted = np.empty((len(rays), 3), np.float32), np.empty(len(rays), np.bool_)
    pixel_angle = np.float32(1 / camera.intrinsics()[0, 0])
    shade(seen, light, appearance, state, lamps, key, lit, open_sky, pixel_angle, radiance, painted)
    rgb = np.empty((len(rays), 3), np.uint8)
    develop(radiance, np.float32(light.exposure), rgb)
    return _exposure(camera, rays, rgb, seen, appearance, painted)


def _exposure(
    camera: Camera,
    rays: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    seen: Survey,
    appearance: Appearance,
    painted: NDArray[np.bool_],
) -> Exposure:
    shape = (camera.height, camera.width)
    semantic = np.empty(len(rays), np.uint8)
    instance = np.empty(len(rays), np.int32)
    _label(seen, appearance, painted, SEMANTICS["sky"], SEMANTICS["road_line"], semantic, instance)
    return Exposure(
        rgb.reshape(*shape, 3),
        (seen.distance * rays[:, 2]).reshape(shape),
        semantic.reshape(shape),
        instance.reshape(shape),
    )


@compiled
def _label(seen, appearance, painted, sky, road_line, semantic, instance):
    for ray in range(len(semantic)):
        row = seen.row[ray]
        if row < 0:
            semantic[ray], instance[ray] = sky, 0
        else:
            semantic[ray] = road_line if painted[ray] else appearance.semantic[row]
            instance[ray] = appearance.thing[row] if seen.instance[ray] == 0 else seen.instance[ray]
