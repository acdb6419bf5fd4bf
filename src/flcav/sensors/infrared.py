"""Simulation of a thermal camera: apparent temperatures in the long-wave infrared (8 to 14 um).

A pixel's apparent temperature is t * (e * T + (1 - e) * T_mirrored) + (1 - t) * T_air, with the surface's temperature T
and emissivity e, the temperature T_mirrored of what it reflects, and the transmittance t = exp(-extinction * distance)
of the air. Temperatures are mixed linearly instead of radiances, which is accurate to about 1 K within 30 K.

T = T_air + difference: a surface in the sun is up to `sun_k` warmer (times the cosine of incidence and the clouds'
transmittance), one that faces a clear night sky up to `sky_k` colder, in proportion to the visible sky; rain reduces
both. Moving vehicles are warm at engine, tyres, brakes and lamps, people at skin and clothes. Window panes reflect the
sky; smooth noise varies the temperatures of the town's surfaces. The extinction of fog in the long-wave infrared is
taken as 0.6 of that of light, that of clear air as 0.2 per km. The lens blurs by `BLUR_PX`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import gaussian_filter

from flcav.arrays import Array, Array32, Bytes
from flcav.machine.compiled import compiled
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.rendering.appearance import Appearance, build_appearance
from flcav.sensors.rendering.facade import shade_facade
from flcav.sensors.rendering.gbuffer import GBuffer, fill_gbuffer
from flcav.sensors.rendering.light import compute_ambient_occlusion, compute_light, compute_sun_visibility, soften
from flcav.sensors.rendering.noise import sample_noise
from flcav.world.materials import Material
from flcav.world.scene import Scene
from flcav.world.static import TownPart
from flcav.world.weather import Weather

FAR_M = 1000.0
KELVIN_STEP = 0.01  # quantisation of a thermal image
FOG_SHARE, CLEAR_AIR_PER_M, RAIN_PER_M = 0.6, 0.0002, 0.0012  # fog's extinction over that of light; air, rain at 1 mm/h
ENGINE_SHARE = 0.28  # length of the engine compartment over that of the vehicle
LAMP_K = 14.0  # warming of a lit lamp
BLUR_PX = 0.6  # standard deviation of the lens' point spread function
PATCHES_K = 1.6  # range of the noise of a surface's temperature
PANE_EMISSIVITY = 0.85
WALL, BUILDING = int(Material.WALL), int(TownPart.BUILDING)


class Warmth(NamedTuple):
    """Thermal properties of a material: differences from the temperature of the air, and emissivity."""

    sun_k: float = 10.0  # warming when facing a clear sun at noon [K]
    sky_k: float = 4.0  # cooling under a clear night sky [K]
    emissivity: float = 0.94  # thermal radiation relative to that of a black body, 0 to 1
    moving_k: float = 0.0  # warming while its vehicle moves [K]
    body_c: float | None = None  # surface temperature of people in any weather [deg C]


WARMTH: dict[Material, Warmth] = {
    Material.GROUND: Warmth(sun_k=9, sky_k=6),
    Material.ROAD: Warmth(sun_k=22, sky_k=-2),  # asphalt stays warm at night
    Material.SIDEWALK: Warmth(sun_k=15, sky_k=0),
    Material.WALL: Warmth(sun_k=14, sky_k=-2),
    Material.ROOF: Warmth(sun_k=24, sky_k=7),
    Material.BARK: Warmth(sun_k=6, sky_k=1),
    Material.LEAF: Warmth(sun_k=3, sky_k=2),
    Material.METAL: Warmth(sun_k=16, sky_k=6, emissivity=0.75),
    Material.SIGN: Warmth(sun_k=12, sky_k=6, emissivity=0.85),
    Material.PAINT: Warmth(sun_k=20, sky_k=6, emissivity=0.90, moving_k=1.5),
    Material.GLASS: Warmth(sun_k=8, sky_k=5, emissivity=0.85, moving_k=2),
    Material.TYRE: Warmth(sun_k=12, sky_k=2, moving_k=16),
    Material.RIM: Warmth(sun_k=10, sky_k=4, emissivity=0.60, moving_k=28),
    Material.HEADLAMP: Warmth(sun_k=8, sky_k=4, emissivity=0.85),
    Material.TAILLAMP: Warmth(sun_k=8, sky_k=4, emissivity=0.90),
    Material.PLATE: Warmth(sun_k=12, sky_k=5, emissivity=0.85),
    Material.TRIM: Warmth(sun_k=14, sky_k=3, moving_k=12),
    Material.INTERIOR: Warmth(sun_k=4, sky_k=1, moving_k=5),
    Material.SKIN: Warmth(sun_k=1, sky_k=0, body_c=32.0),
    Material.CLOTH: Warmth(sun_k=5, sky_k=0, body_c=25.0),
    Material.TROUSERS: Warmth(sun_k=5, sky_k=0, body_c=23.0),
    Material.LAMP: Warmth(sun_k=8, sky_k=5),
    Material.LENS_RED: Warmth(sun_k=8, sky_k=4),
    Material.LENS_AMBER: Warmth(sun_k=8, sky_k=4),
    Material.LENS_GREEN: Warmth(sun_k=8, sky_k=4),
}
_SUN, _SKY, _EMISSIVITY, _MOVING = np.array([WARMTH[material][:4] for material in Material]).T
_BODY = np.array([np.nan if WARMTH[material].body_c is None else WARMTH[material].body_c for material in Material])


class Infrared(Lens):
    """Settings of a thermal camera; its mount is in the rig."""

    noise_k: float = Field(default=0.06, ge=0, le=5)  # standard deviation of a pixel's temperature


def render_thermal(
    scene: Scene,
    world_from_camera: Array,
    infrared: Infrared,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None = None,
) -> NDArray[np.uint16]:
    """Render a thermal image (H, W) of apparent temperatures [0.01 K], without the actor `hidden` (the carrier).

    `world_from_camera` (4, 4) [m] is the pose of the optical frame, as for `camera.photograph`.
    """
    rays = compute_pixel_rays(infrared)
    appearance, light = build_appearance(scene), compute_light(weather)
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=hidden)
    seen = fill_gbuffer(scene, appearance, world_from_camera, rays, hits)
    lit = soften(compute_sun_visibility(scene, seen, light, hidden), seen, infrared.width)
    free = compute_ambient_occlusion(scene, seen, infrared, hidden)
    pane, patch = _texture_of(seen, appearance, infrared)
    met = seen.row >= 0
    material = appearance.material[np.maximum(seen.row, 0)]
    air = air_temperature(weather)
    heat = lit * np.clip(seen.normal @ np.array(light.to_sun), 0, 1) * _sunshine(weather)
    cold = free * (0.5 + 0.5 * seen.normal[:, 2]) * (1 - 0.9 * weather.cloud_cover)
    night = float(np.clip((8.0 - weather.sun_elevation_deg) / 14.0, 0, 1))
    dry = 1 - 0.8 * max(weather.wetness, min(weather.rain_mm_h / 5.0, 1.0))
    surface_k = (
        _SUN[material] * heat - night * _SKY[material] * np.where(_SKY[material] > 0, cold, 1.0) + PATCHES_K * patch
    )
    surface_k = (
        air + dry * surface_k + _living(seen, material, air) + _driving(scene, seen, material, bool(light.lamps > 0.5))
    )
    rise = seen.ray[:, 2] - 2 * np.einsum("ij,ij->i", seen.ray, seen.normal) * seen.normal[:, 2]
    mirrored = np.where(rise > 0, sky_temperature(weather, rise), air)
    emissivity = np.where(pane > 0, 1 - pane * (1 - PANE_EMISSIVITY), _EMISSIVITY[material])
    shown = emissivity * surface_k + (1 - emissivity) * mirrored
    shown = np.where(met, shown, sky_temperature(weather, seen.ray[:, 2]))
    extinction = FOG_SHARE * weather.fog_per_m + CLEAR_AIR_PER_M + RAIN_PER_M * weather.rain_mm_h**0.6
    passes = np.where(met, np.exp(-extinction * np.where(met, seen.distance, 0)), np.exp(-extinction * 500.0))
    shape = (infrared.height, infrared.width)
    kelvin = gaussian_filter((passes * shown + (1 - passes) * air).reshape(shape), BLUR_PX)
    kelvin += infrared.noise_k * rng.standard_normal(shape, np.float32)
    return np.rint(kelvin / KELVIN_STEP).clip(0, 65535).astype(np.uint16)


def air_temperature(weather: Weather) -> float:
    """Return the air temperature [K]: 286 + 9 * sin(sun elevation), lower under clouds by day and in rain."""
    warm = 9.0 * np.sin(np.radians(np.clip(weather.sun_elevation_deg, -30, 90)))
    return float(286.0 + warm - 2.5 * weather.cloud_cover * (warm > 0) - min(weather.rain_mm_h / 10.0, 1.0) * 2.0)


def sky_temperature(weather: Weather, rise: Array32 | float) -> Array:
    """Return the apparent temperature of the sky [K] at the elevation whose sine is `rise`; clouds are warmer."""
    clear = 42.0 * np.clip(rise, 0, 1) ** 0.5 + 6.0
    return air_temperature(weather) - clear * (1 - 0.85 * weather.cloud_cover)


def _sunshine(weather: Weather) -> float:
    """Return the heat of the sun through clouds, relative to a clear noon."""
    height = max(np.sin(np.radians(weather.sun_elevation_deg)), 0.0)
    return float(np.clip(height * 3, 0, 1) * (1 - 0.85 * np.clip((weather.cloud_cover - 0.3) / 0.6, 0, 1)))


def _living(seen: GBuffer, material: Bytes, air: float) -> Array:
    """Return (N,) the difference of skin and clothes from the air temperature [K]; 0 for other surfaces."""
    body = _BODY[material] + 273.15
    clothed = np.where(material == Material.SKIN, 1.0, 0.7)
    return np.where(np.isnan(body) | (seen.instance < 1), 0.0, clothed * (body - air))


def _driving(scene: Scene, seen: GBuffer, material: Bytes, lamps_on: bool) -> Array:
    """Return (N,) the warming of parts of vehicles in traffic over parked ones [K]; 0 for other surfaces."""
    trace = scene.trace
    warm = np.zeros(len(seen))
    for actor in np.unique(seen.instance[seen.instance > 0]) - 1:
        if trace.category[actor] in ("pedestrian", "bicycle", "prop") or str(trace.actor[actor]).startswith("parked"):
            continue
        rows = np.flatnonzero(seen.instance == actor + 1)
        body = scene.world_from_actor(int(actor))
        along = (seen.position[rows] - body[:3, 3]) @ body[:3, 0] / trace.size[actor, 0]
        low = seen.position[rows, 2] - body[2, 3] < 0.62 * trace.size[actor, 2]
        bonnet = np.clip((along - 0.5 + ENGINE_SHARE) / 0.08, 0, 1) * low
        part_material = material[rows]
        warm[rows] = _MOVING[part_material] + np.where(part_material == Material.PAINT, 9.0 * bonnet, 0) + 5.0 * bonnet
        if lamps_on:
            warm[rows] += LAMP_K * ((part_material == Material.HEADLAMP) | (part_material == Material.TAILLAMP))
    return warm


def _texture_of(seen: GBuffer, appearance: Appearance, infrared: Infrared) -> tuple[Array32, Array32]:
    """Return the pixels' shares (N,) of window panes, and temperature noise (N,), -0.5 to 0.5."""
    pane, patch = np.zeros(len(seen), np.float32), np.zeros(len(seen), np.float32)
    _texture(seen, appearance, np.float32(1 / infrared.intrinsics()[0, 0]), pane, patch)
    return pane, patch


@compiled
def _texture(seen, appearance, pixel_angle, pane, patch):
    table = appearance.noise
    for ray in range(len(pane)):
        row = seen.row[ray]
        if row < 0 or seen.instance[ray] > 0:
            continue
        x, y, z = seen.position[ray, 0], seen.position[ray, 1], seen.position[ray, 2]
        broad = sample_noise(table, (x + z) * 0.25, (y - z) * 0.25)
        patch[ray] = (
            np.float32(0.7) * broad
            + np.float32(0.3) * sample_noise(table, (x + z) * 2.1, (y - z) * 2.1)
            - np.float32(0.5)
        )
        if appearance.material[row] == WALL and appearance.part[row] == BUILDING:
            nx, ny = seen.normal[ray, 0], seen.normal[ray, 1]
            facing = -(seen.ray[ray, 0] * nx + seen.ray[ray, 1] * ny + seen.ray[ray, 2] * seen.normal[ray, 2])
            across = seen.distance[ray] * pixel_angle
            slant = across / max(facing, np.float32(0.02))
            building = appearance.part_row[row]
            facade = shade_facade(building, x, y, z, nx, ny, across, slant, appearance.facades, table)
            pane[ray] = facade[3]
