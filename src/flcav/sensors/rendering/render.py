"""Deferred renderer: primary rays, G-buffer, shading, wet reflections, supersampling, rain and glare, in this order.

The result is the radiance of every pixel; exposure and tone mapping follow in `flcav.sensors.camera.tone`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.machine.memory import keep_freed_memory
from flcav.machine.threads import share_among_threads
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.rendering import rain, supersampling
from flcav.sensors.rendering.ambient_occlusion import compute_ambient_occlusion
from flcav.sensors.rendering.appearance import Appearance, build_appearance
from flcav.sensors.rendering.gbuffer import GBuffer, fill_gbuffer
from flcav.sensors.rendering.glare import add_glare, add_sun_glare
from flcav.sensors.rendering.light import Illumination, compute_lamplight, compute_light, compute_sun_visibility, soften
from flcav.sensors.rendering.state import Lamps, LampState, collect_lamps, compute_lamp_state, no_lamps
from flcav.sensors.rendering.surface import mark_paint, shade
from flcav.world.rays.hits import Hits
from flcav.world.scene import Scene
from flcav.world.weather import Weather

FAR_M = 1000.0  # length of primary rays
LOW_SIGHT = 0.002  # extinction [1/m] above which vehicles have their lamps on by day
MIRRORS = 0.2  # wetness above which roads reflect
NO_LAMPS = np.zeros((0, 3), np.float32)


class RadianceImage(NamedTuple):
    """An image as radiance, with its exposure, G-buffer and appearance tables."""

    radiance: NDArray[np.float32]  # (N, 3) of each pixel, row after row
    exposure: np.float32  # factor of the radiance before tone mapping
    seen: GBuffer  # G-buffer of the primary rays
    painted: NDArray[np.bool_]  # (N,) whether a pixel shows a road marking
    appearance: Appearance


class _World(NamedTuple):
    scene: Scene
    appearance: Appearance
    light: Illumination
    state: LampState
    lamps: Lamps
    pixel_angle: np.float32
    hidden: int | None
    threads: int


def render(
    scene: Scene,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None,
    threads: int = 1,
) -> RadianceImage:
    """Return the radiance of every pixel of `lens` at the scene's instant: see `camera.photograph`.

    `world_from_camera` (4, 4) is the pose of the optical frame, `hidden` the actor left out (the carrier); `rng` draws
    the rain. Rays are cast and shaded by `threads` threads.
    """
    keep_freed_memory()
    rays, light, appearance = compute_pixel_rays(lens), compute_light(weather), build_appearance(scene)
    state = compute_lamp_state(scene, float(light.lamps), low_sight=bool(light.extinction > LOW_SIGHT))
    angle = np.float32(1 / lens.intrinsics()[0, 0])
    lamps = collect_lamps(scene, state) if light.lamps > 0 else no_lamps()
    world = _World(scene, appearance, light, state, lamps, angle, hidden, threads)
    seen = _meet(world, world_from_camera, rays)
    open_sky = compute_ambient_occlusion(scene, seen, lens, hidden, threads)
    radiance, painted = _radiance(world, seen, open_sky, lens.width)
    if light.wetness > MIRRORS:
        _mirror(world, world_from_camera, lens, rays, seen, radiance)
    kind = supersampling.find_edges(seen, radiance, light.exposure, appearance, lens, threads)
    supersampling.mark_thin(kind, scene.town, world_from_camera, lens, seen)
    further, pixel = supersampling.further_rays(rays, kind, lens)
    if len(pixel):
        more = _further(world, world_from_camera, further, pixel, lens.width, seen, open_sky, radiance)
        supersampling.average(radiance, more, pixel, np.float32(supersampling.BRIGHTEST / light.exposure))
    image = radiance.reshape(lens.height, lens.width, 3)
    if weather.rain_mm_h > 0:
        rain.add_streaks(image, weather.rain_mm_h, 0.75 * np.array(light.horizon) + 0.05 * np.array(light.sun), rng)
    if state.head.any() or light.lamps > 0:
        add_glare(image, scene, state, light, world_from_camera, lens, hidden)
    add_sun_glare(image, scene, light, world_from_camera, lens, hidden)
    return RadianceImage(radiance, light.exposure, seen, painted, appearance)


def survey(
    scene: Scene, world_from_camera: NDArray[np.float64], lens: Lens, *, hidden: int | None, threads: int = 1
) -> tuple[GBuffer, NDArray[np.bool_], Appearance]:
    """Return what the rays through the pixels' centres meet, and where that is paint (N,), as `render` does."""
    rays, appearance = compute_pixel_rays(lens), build_appearance(scene)
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=hidden, threads=threads)
    seen = fill_gbuffer(scene, appearance, world_from_camera, rays, hits, threads)
    painted = np.empty(len(seen), np.bool_)
    angle = np.float32(1 / lens.intrinsics()[0, 0])

    def mark(first: int, last: int) -> None:
        at = slice(first, last)
        mark_paint(seen.part(at), appearance, angle, painted[at])

    share_among_threads(mark, len(seen), threads)
    return seen, painted, appearance


def _meet(
    world: _World,
    world_from_camera: NDArray[np.float64],
    rays: NDArray[np.float32],
    near_m: NDArray[np.float32] | None = None,
) -> GBuffer:
    reach, hidden, threads = FAR_M, world.hidden, world.threads
    hits = world.scene.cast(world_from_camera, rays, near_m=near_m, far_m=reach, hidden=hidden, threads=threads)
    return fill_gbuffer(world.scene, world.appearance, world_from_camera, rays, hits, threads)


def _radiance(
    world: _World, seen: GBuffer, open_sky: NDArray[np.float32], width: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    scene, light, hidden, threads = world.scene, world.light, world.hidden, world.threads
    lit = compute_sun_visibility(scene, seen, light, hidden, threads)
    if width is not None:  # the rays are those of a whole image
        lit = soften(lit, seen, width, threads)
    lamplight = compute_lamplight(scene, seen, world.lamps, hidden, threads) if light.lamps > 0 else NO_LAMPS
    radiance, painted = np.empty((len(seen), 3), np.float32), np.empty(len(seen), np.bool_)
    tables, angle = (light, world.appearance, world.state), world.pixel_angle

    def shade_part(first: int, last: int) -> None:
        at = slice(first, last)
        shade(seen.part(at), *tables, lit[at], lamplight[at], open_sky[at], angle, radiance[at], painted[at])

    share_among_threads(shade_part, len(seen), threads)
    return radiance, painted


def _further(
    world: _World,
    world_from_camera: NDArray[np.float64],
    rays: NDArray[np.float32],
    pixel: NDArray[np.int32],
    width: int,
    seen: GBuffer,
    open_sky: NDArray[np.float32],
    radiance: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the radiance (S, 3) of further rays, each within a `pixel` (S,): taken from a pixel nearby, or shaded."""
    scene, appearance = world.scene, world.appearance
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=world.hidden, threads=world.threads)
    donor = np.empty(len(rays), np.int32)
    supersampling.donors(hits, pixel, seen, scene.surfaces.first, appearance.material, width, donor)
    out, rest = radiance[donor], np.flatnonzero(donor < 0)
    unknown = Hits(hits.distance[rest], hits.instance[rest], hits.face[rest])
    found = fill_gbuffer(scene, appearance, world_from_camera, rays[rest], unknown)
    finer = world._replace(pixel_angle=world.pixel_angle / supersampling.ROOKS)
    out[rest], _ = _radiance(finer, found, open_sky[pixel[rest]])
    return out


def _mirror(
    world: _World,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    rays: NDArray[np.float32],
    seen: GBuffer,
    radiance: NDArray[np.float32],
) -> None:
    """Add planar reflections to wet roads: rays cast from the camera mirrored at the plane of the road, z = 0."""
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
