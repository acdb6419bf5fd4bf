"""The renderer of camera images: rays to radiance."""

import ctypes
import platform
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.camera.lens import Lens, directions
from flcav.sensors.rendering import rain
from flcav.sensors.rendering import supersampling as antialias
from flcav.sensors.rendering import supersampling as edges
from flcav.sensors.rendering.ambient_occlusion import openness
from flcav.sensors.rendering.appearance import Appearance, appearance_of
from flcav.sensors.rendering.gbuffer import Survey, survey
from flcav.sensors.rendering.glare import add_glare, add_sun_glare
from flcav.sensors.rendering.light import Light, lamp_light_on, light_of, soften, sunlit
from flcav.sensors.rendering.state import Lamps, State, lamps_of, no_lamps, state_of
from flcav.sensors.rendering.surface import shade
from flcav.world.rays.raycaster import Hits
from flcav.world.scene import Scene
from flcav.world.weather import Weather

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3)
KEPT_BYTES = 64 << 20
LARGEST_BYTES = 32 << 20  # the most that glibc takes


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Let this process keep up to `KEPT_BYTES` of what it frees, where the C library is glibc; elsewhere do nothing.

    By default glibc hands arrays of megabytes back to the system, which clears every page anew for the next image: a
    seventh of an image's time.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, LARGEST_BYTES)
        library.mallopt(_TRIM_THRESHOLD, KEPT_BYTES)


FAR_M = 1000.0
LOW_SIGHT = 0.002  # [1/m] of extinction from which on vehicles have their lamps on by day
MIRRORS = 0.2  # wetness from which on a road mirrors
NO_LAMPS = np.zeros((0, 3), np.float32)


class Picture(NamedTuple):
    """An image before it is developed, and what its first rays met."""

    radiance: NDArray[np.float32]  # (N, 3) of each pixel
    exposure: np.float32
    seen: Survey
    painted: NDArray[np.bool_]  # (N,) whether a pixel shows paint on a road
    appearance: Appearance


class _World(NamedTuple):
    scene: Scene
    appearance: Appearance
    light: Light
    state: State
    lamps: Lamps
    pixel_angle: np.float32
    hidden: int | None


def render(
    scene: Scene,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None,
) -> Picture:
    """Return the light that falls on every pixel of `lens`, row after row: see `camera.photograph`."""
    keep_freed_memory()
    rays, light, appearance = directions(lens), light_of(weather), appearance_of(scene)
    state = state_of(scene, float(light.lamps), low_sight=bool(light.extinction > LOW_SIGHT))
    angle = np.float32(1 / lens.intrinsics()[0, 0])
    world = _World(
        scene, appearance, light, state, lamps_of(scene, state) if light.lamps > 0 else no_lamps(), angle, hidden
    )
    seen = _meet(world, world_from_camera, rays)
    open_sky = openness(scene, seen, lens, hidden)
    radiance, painted = _radiance(world, seen, open_sky, lens.width)
    if light.wetness > MIRRORS:
        _mirror(world, world_from_camera, lens, rays, seen, radiance)
    kind = edges.rough_pixels(seen, radiance, light.exposure, appearance, lens)
    edges.mark_thin(kind, scene.town, world_from_camera, lens, seen)
    further, pixel = antialias.further_rays(rays, kind, lens)
    if len(pixel):
        more = _further(world, world_from_camera, further, pixel, lens.width, seen, open_sky, radiance)
        antialias.average(radiance, more, pixel, np.float32(antialias.BRIGHTEST / light.exposure))
    image = radiance.reshape(lens.height, lens.width, 3)
    if weather.rain_mm_h > 0:
        rain.add_streaks(image, weather.rain_mm_h, 0.75 * np.array(light.horizon) + 0.05 * np.array(light.sun), rng)
    if state.head.any() or light.lamps > 0:
        add_glare(image, scene, state, light, world_from_camera, lens, hidden)
    add_sun_glare(image, scene, light, world_from_camera, lens, hidden)
    return Picture(radiance, light.exposure, seen, painted, appearance)


def _meet(
    world: _World,
    world_from_camera: NDArray[np.float64],
    rays: NDArray[np.float32],
    near_m: NDArray[np.float32] | None = None,
) -> Survey:
    hits = world.scene.cast(world_from_camera, rays, near_m=near_m, far_m=FAR_M, hidden=world.hidden)
    return survey(world.scene, world.appearance, world_from_camera, rays, hits)


def _radiance(
    world: _World, seen: Survey, open_sky: NDArray[np.float32], width: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    scene, light, hidden = world.scene, world.light, world.hidden
    lit = sunlit(scene, seen, light, hidden)
    if width is not None:  # the rays are a whole picture's
        lit = soften(lit, seen, width)
    lamplight = lamp_light_on(scene, seen, world.lamps, hidden) if light.lamps > 0 else NO_LAMPS
    radiance, painted = np.empty((len(seen), 3), np.float32), np.empty(len(seen), np.bool_)
    tables = (light, world.appearance, world.state)
    shade(seen, *tables, lit, lamplight, open_sky, world.pixel_angle, radiance, painted)
    return radiance, painted


def _further(
    world: _World,
    world_from_camera: NDArray[np.float64],
    rays: NDArray[np.float32],
    pixel: NDArray[np.int32],
    width: int,
    seen: Survey,
    open_sky: NDArray[np.float32],
    radiance: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the light (S, 3) of further rays, each within a `pixel` (S,): what a pixel close by shows, or shaded."""
    scene, appearance = world.scene, world.appearance
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=world.hidden)
    donor = np.empty(len(rays), np.int32)
    antialias.donors(hits, pixel, seen, scene.surfaces.first, appearance.material, width, donor)
    out, rest = radiance[donor], np.flatnonzero(donor < 0)
    unknown = Hits(hits.distance[rest], hits.instance[rest], hits.face[rest])
    found = survey(scene, appearance, world_from_camera, rays[rest], unknown)
    finer = world._replace(pixel_angle=world.pixel_angle / antialias.ROOKS)
    out[rest], _ = _radiance(finer, found, open_sky[pixel[rest]])
    return out


def _mirror(
    world: _World,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    rays: NDArray[np.float32],
    seen: Survey,
    radiance: NDArray[np.float32],
) -> None:
    """Add to wet roads what they mirror: what the same rays meet from below the road, with the world upside down."""
    wet = rain.wet_pixels(seen, world.appearance, lens.width, lens.height)
    if not len(wet):
        return
    below = np.diag((1.0, 1.0, -1.0, 1.0)) @ world_from_camera
    met = _meet(world, below, np.ascontiguousarray(rays[wet]), near_m=seen.distance[wet] + np.float32(0.05))
    found, _ = _radiance(world, met, np.ones(len(wet), np.float32))
    width, height = lens.width // 2, lens.height // 2
    image, weight = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    j, i = wet // lens.width // 2, wet % lens.width // 2
    image[j, i], weight[j, i] = found, 1
    smeared = np.zeros_like(image)
    rain.smear(image, weight, width, height, smeared)
    light = world.light
    rain.add_mirrored(
        radiance, seen, world.appearance, smeared, light.wetness, light.extinction, lens.width, lens.height
    )
