"""Illumination: sun, sky and air by weather, shadows of the sun and of lamps by shadow rays, and ambient occlusion.

One unit of radiance is the brightness that a camera exposed for full daylight shows as white. For shadows, one ray is
cast from every hit to the sun, and one to the strongest lamp.

Ambient occlusion casts one short ray for every block of 2 x 2 pixels, and averages over 4 x 4 neighbouring blocks. Ray
directions are cosine-weighted, and different in these 16 blocks.
"""

from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32
from flcav.machine.compiled import compiled
from flcav.machine.threads import share_among_threads
from flcav.sensors.lens import Lens
from flcav.sensors.rendering.gbuffer import GBuffer
from flcav.sensors.rendering.state import Lamps, light_up
from flcav.world.scene import Scene
from flcav.world.weather import Weather

Colour = tuple[np.float32, np.float32, np.float32]  # scalars: compiled code passes arrays less cheaply

RAIN_EXTINCTION = 0.00022  # 1/m at 1 mm/h, growing with the rain's power of 0.63 (Atlas 1953, visible light)

# Sun elevation [deg] -> irradiance of the sun at normal incidence, and radiance of the sky at zenith and horizon
_ELEVATION = (-18.0, -9.0, -4.0, 0.0, 4.0, 10.0, 25.0, 60.0)
_SUN = (
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0),
    (0.32, 0.10, 0.02),
    (1.05, 0.47, 0.16),
    (1.62, 1.06, 0.62),
    (2.00, 1.74, 1.38),
    (2.20, 2.08, 1.86),
)
_ZENITH = (
    (0.0007, 0.0009, 0.0016),
    (0.004, 0.006, 0.013),
    (0.030, 0.044, 0.090),
    (0.085, 0.115, 0.210),
    (0.130, 0.180, 0.310),
    (0.150, 0.240, 0.430),
    (0.150, 0.290, 0.570),
    (0.145, 0.300, 0.620),
)
_HORIZON = (
    (0.0028, 0.0024, 0.0026),
    (0.014, 0.011, 0.014),
    (0.130, 0.085, 0.090),
    (0.420, 0.210, 0.120),
    (0.700, 0.400, 0.230),
    (0.720, 0.600, 0.490),
    (0.640, 0.720, 0.800),
    (0.600, 0.730, 0.860),
)

SUN_REACH_M = 300.0  # length of shadow rays
DARK = 1e-3  # irradiance of the sun below which it casts no shadow
SAME = 0.04  # relative difference of distance up to which two pixels are taken to be on one surface


class Illumination(NamedTuple):
    """Illumination in one weather: light of sun and sky, and scattering by the air."""

    to_sun: Colour  # unit direction, world frame
    sun: Colour  # irradiance at normal incidence, through the clouds
    zenith: Colour  # radiance of the clear sky overhead
    horizon: Colour  # radiance of the sky at the horizon
    ambient: Colour  # irradiance of the whole sky on a horizontal surface
    bounce: Colour  # irradiance from the ground on a surface that faces down
    cloud: Colour  # radiance of a cloud
    cover: np.float32  # share of the sky covered by clouds
    air: Colour  # radiance of the air itself (airlight), at infinite distance
    extinction: np.float32  # [1/m] by fog, haze and rain
    exposure: np.float32  # factor before tone mapping
    wetness: np.float32
    lamps: np.float32  # brightness of street lamps, 0 to 1


def compute_light(weather: Weather) -> Illumination:
    """Return the illumination in `weather`: tables by the sun's elevation, modified by clouds, fog and rain."""
    elevation, azimuth = np.radians(weather.sun_elevation_deg), np.radians(weather.sun_azimuth_deg)
    level = np.cos(elevation)
    to_sun = np.array([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)])
    clear_sun, zenith, horizon = (_at(weather.sun_elevation_deg, table) for table in (_SUN, _ZENITH, _HORIZON))
    through = 1 - np.clip((weather.cloud_cover - 0.3) / 0.6, 0, 1)  # gaps close from a third of the sky on
    fog = weather.fog_per_m
    sun = clear_sun * through * np.exp(-120.0 * fog)
    whole = 0.35 * clear_sun * max(np.sin(elevation), 0.06) + 0.5 * (zenith + horizon)
    grey = whole.mean() * np.array([0.97, 1.0, 1.04])
    deck = np.clip((weather.cloud_cover - 0.4) / 0.6, 0, 1)
    cloud = grey * (1.25 - 0.55 * deck)
    hazy = np.clip(fog * 400, 0, 1) * (1 - 0.3 * deck)
    over = deck * 0.92
    zenith = zenith * (1 - over) + cloud * over
    horizon = horizon * (1 - over) + cloud * over
    zenith = zenith * (1 - 0.6 * hazy) + 0.6 * hazy * horizon
    air = 0.9 * horizon if fog else 0.95 * horizon
    haze = 0.00012
    rain = RAIN_EXTINCTION * weather.rain_mm_h**0.63 * 3.0
    lamps = float(np.clip((2.0 - weather.sun_elevation_deg) / 6.0, 0, 1))
    sky = 0.45 * zenith + 0.55 * horizon
    sky = 0.55 * sky + 0.45 * sky.mean()  # reflections from houses and ground make skylight less blue
    bounce = 0.16 * (sun * max(to_sun[2], 0.0) + sky)
    ambient = float((0.5 * sun * max(to_sun[2], 0.15) + 0.6 * zenith + 0.4 * horizon).mean())
    return Illumination(
        to_sun=_three(to_sun),
        sun=_three(sun),
        zenith=_three(zenith),
        horizon=_three(horizon),
        ambient=_three(sky),
        bounce=_three(bounce),
        cloud=_three(cloud),
        cover=np.float32(weather.cloud_cover),
        air=_three(air),
        extinction=np.float32(fog + haze + rain),
        exposure=np.float32(_exposure(ambient)),
        wetness=np.float32(weather.wetness),
        lamps=np.float32(lamps),
    )


def _three(values: Array) -> Colour:
    return np.float32(values[0]), np.float32(values[1]), np.float32(values[2])


def _at(elevation_deg: float, table: tuple[tuple[float, float, float], ...]) -> Array:
    return np.array([np.interp(elevation_deg, _ELEVATION, column) for column in zip(*table)])


def _exposure(ambient: float) -> float:
    """Return the exposure for an `ambient` brightness: a power law with exponent -0.55, so that nights stay dark."""
    return float(0.92 * max(ambient, 2e-3) ** -0.55 if ambient < 1.0 else 0.92)


def compute_lamplight(scene: Scene, seen: GBuffer, lamps: Lamps, hidden: int | None, threads: int = 1) -> Array32:
    """Return the irradiance (N, 3) of lamps at hits; only the strongest lamp at a hit casts shadows."""
    light, most, towards = (np.zeros((len(seen), 3), np.float32) for _ in range(3))
    far = np.empty(len(seen), np.float32)
    light_up(seen, lamps, light, most, towards, far)
    _add_where_free(light, most, scene.find_occluded(seen.position, towards, far, hidden=hidden, threads=threads))
    return light


def compute_sun_visibility(
    scene: Scene, seen: GBuffer, light: Illumination, hidden: int | None, threads: int = 1
) -> Array32:
    """Return (N,) 0 for hits in the sun's shadow, else 1, also for surfaces that face away from the sun."""
    far = np.empty(len(seen), np.float32)
    _facing(seen, light.to_sun, max(light.sun) > DARK, far)
    to_sun = np.array([light.to_sun])
    blocked = scene.find_occluded(seen.position, to_sun, far, hidden=hidden, threads=threads)
    return (~blocked).view(np.uint8).astype(np.float32)


def soften(lit: Array32, seen: GBuffer, width: int, threads: int = 1) -> Array32:
    """Return `lit` (N,), an image in row order, with softened shadow edges, as from an extended sun.

    A 3 x 3 binomial filter (weights 1, 2, 1 in both directions) over pixels at a similar distance.
    """
    out = np.empty_like(lit)

    def soften_rows(first: int, last: int) -> None:
        _soften(lit, seen.distance, width, first, last, out)

    share_among_threads(soften_rows, len(lit) // width, threads)
    return out


@compiled
def _facing(seen, to_sun, shines, far):
    for ray in range(len(far)):
        normal = seen.normal[ray]
        turned = normal[0] * to_sun[0] + normal[1] * to_sun[1] + normal[2] * to_sun[2]
        far[ray] = SUN_REACH_M if shines and seen.row[ray] >= 0 and turned > 0 else -1.0


@compiled
def _add_where_free(light, most, blocked):
    for ray in range(len(blocked)):
        if not blocked[ray]:
            for band in range(3):
                light[ray, band] += most[ray, band]


@compiled
def _soften(lit, distance, width, first, last, out):
    column = 0
    for pixel in range(
        max(first * width, 0), last * width
    ):  # the `max` proves to the compiler that indices are not negative
        column = column + 1 if column < width else 1  # counted from 1
        centre = lit[pixel]
        out[pixel] = centre
        if column == 1 or column == width or pixel < width or pixel >= len(lit) - width:
            continue
        if (
            lit[pixel - 1] == centre
            and lit[pixel + 1] == centre
            and lit[pixel - width] == centre
            and lit[pixel + width] == centre
        ):
            continue
        total, weight, near = np.float32(0), np.float32(0), np.float32(SAME) * distance[pixel]
        for down in range(-1, 2):
            for right in range(-1, 2):
                other = pixel + down * width + right
                if abs(distance[other] - distance[pixel]) <= near:
                    share = np.float32((2 - abs(down)) * (2 - abs(right)))
                    total += share * lit[other]
                    weight += share
        if weight > 0:
            out[pixel] = total / weight


REACH_M = 2.2  # length of ambient occlusion rays
FARTHEST_M = 40.0  # distance from the camera beyond which ambient occlusion is not computed
DARKEST = 0.15  # value where all rays are blocked
SPAN = 4  # blocks per side of the neighbourhood that is averaged over


def compute_ambient_occlusion(scene: Scene, seen: GBuffer, lens: Lens, hidden: int | None, threads: int = 1) -> Array32:
    """Return the ambient occlusion (N,) of pixels: the unoccluded share of the hemisphere, scaled to DARKEST..1.

    Only objects within REACH_M occlude, except the actor `hidden`.
    """
    columns, rows = -(-lens.width // 2), -(-lens.height // 2)
    blocks = (
        SPAN,
        SPAN,
        -(-rows // SPAN),
        -(-columns // SPAN),
    )  # rays of one direction are consecutive, which is faster
    origin, towards = np.empty((*blocks, 3), np.float32), np.empty((*blocks, 3), np.float32)
    far = np.full(blocks, -1, np.float32)
    _hemisphere(seen, lens.width, rows, _ways(), origin, towards, far)
    starts, aims = origin.reshape(-1, 3), towards.reshape(-1, 3)
    blocked = scene.find_occluded(starts, aims, far.ravel(), hidden=hidden, threads=threads)
    around = blocked.reshape(blocks).transpose(2, 0, 3, 1).reshape(blocks[2] * SPAN, -1)[:rows, :columns]
    around, out = np.ascontiguousarray(around).view(np.uint8), np.empty(len(seen), np.float32)

    def spread(first: int, last: int) -> None:
        _spread(seen, around, lens.width, lens.height, first, last, out)

    share_among_threads(spread, rows, threads)
    return out


def _ways() -> Array32:
    """Return (SPAN, SPAN, 3) points spread evenly over the unit sphere (Fibonacci lattice).

    A unit normal plus such a point is a cosine-weighted direction in the normal's hemisphere.
    """
    count = SPAN * SPAN
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    level = np.sqrt(1 - z**2)
    return np.stack((level * np.cos(angle), level * np.sin(angle), z), axis=1).reshape(SPAN, SPAN, 3).astype(np.float32)


@compiled
def _hemisphere(seen, width, rows, ways, origin, towards, far):
    columns = (width + 1) // 2
    for row in range(rows):
        for column in range(columns):
            pixel = 2 * row * width + 2 * column
            if seen.row[pixel] < 0 or seen.distance[pixel] > FARTHEST_M:
                continue
            b, a, j, i = row % SPAN, column % SPAN, row // SPAN, column // SPAN
            x = seen.normal[pixel, 0] * np.float32(1.02) + ways[b, a, 0]
            y = seen.normal[pixel, 1] * np.float32(1.02) + ways[b, a, 1]
            z = seen.normal[pixel, 2] * np.float32(1.02) + ways[b, a, 2]
            length = np.sqrt(x * x + y * y + z * z)
            towards[b, a, j, i, 0], towards[b, a, j, i, 1], towards[b, a, j, i, 2] = x / length, y / length, z / length
            for axis in range(3):
                origin[b, a, j, i, axis] = seen.position[pixel, axis]
            far[b, a, j, i] = REACH_M


@compiled
def _spread(seen, blocked, width, height, first, last, out):
    """Write the ambient occlusion of the blocks in rows `first` to `last`: 1 where no ray nearby is blocked."""
    # A sliding window of column sums finds the many blocks without a blocked ray in their neighbourhood.
    half = SPAN // 2
    columns = blocked.shape[1]
    along = np.zeros(columns, np.int64)  # blocked rays in the neighbourhood's rows, by column
    for row in range(max(first - half, 0), min(first + half - 1, len(blocked))):
        for column in range(columns):
            along[column] += blocked[row, column]
    for row in range(first, last):
        entering, left = row + half - 1, row - half - 1
        for column in range(columns):
            if entering < len(blocked):
                along[column] += blocked[entering, column]
            if left >= max(first - half, 0):
                along[column] -= blocked[left, column]
        for column in range(columns):
            pixel = 2 * row * width + 2 * column
            share, around = np.float32(1), 0
            for i in range(max(column - half, 0), min(column + half, columns)):
                around += along[i]
            if around > 0 and seen.row[pixel] >= 0:
                free, total = np.float32(0), np.float32(0)
                near = np.float32(0.1) * seen.distance[pixel] + np.float32(0.1)
                for j in range(max(row - half, 0), min(row + half, len(blocked))):
                    for i in range(max(column - half, 0), min(column + half, columns)):
                        other = 2 * j * width + 2 * i
                        if seen.row[other] >= 0 and abs(seen.distance[other] - seen.distance[pixel]) <= near:
                            total += 1
                            if not blocked[j, i]:
                                free += 1
                share = free / total if total > 0 else np.float32(1)
            share = np.float32(DARKEST) + np.float32(1 - DARKEST) * share
            for y in range(2 * row, min(2 * row + 2, height)):
                for x in range(2 * column, min(2 * column + 2, width)):
                    out[y * width + x] = share
