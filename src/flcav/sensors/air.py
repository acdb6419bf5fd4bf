"""What rain and fog do to a LiDAR's echoes on their way: all get weaker, and the air itself may answer louder."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.fog import QUANTILES, SPREAD_M, STEP_M, soft_returns
from flcav.sensors.rain import SHARES, Drops, drops, rain_extinction, rain_range_noise
from flcav.world.rays.compiled import compiled
from flcav.world.weather import Weather

Floats = NDArray[np.float32]
NO_FOG = np.zeros(1, np.float32), np.zeros(1, np.float32)
NO_DROPS = Drops(np.zeros(1, np.float32), np.zeros(1, np.float32), np.zeros((1, SHARES), np.float32))


class Air(NamedTuple):
    """The air between a LiDAR and what it looks at; powers are relative to a white surface at 1 m."""

    two_way_per_m: float  # twice the extinction coefficient
    range_noise: float  # standard deviation of the measured range, as a share of the range
    soft_power: Floats  # (K,) of the fog before a surface at k * STEP_M; zero without fog
    soft_range_m: Floats  # (K,)
    drop_number: Floats  # (L,) mean number of drops in a beam brighter than `drop_power`; zero without rain
    drop_power: Floats  # (L,)
    drop_range_m: Floats  # (L, SHARES) quantiles


def air_in(weather: Weather, divergence_rad: float, least_power: float) -> Air | None:
    """Return the air of `weather`; None where it is clear.

    A beam is as wide as `divergence_rad` times the range; drops that send back less than `least_power` do not matter.
    """
    rain, fog = weather.rain_mm_h, weather.fog_per_m
    if rain == 0 and fog == 0:
        return None
    extinction = fog + rain_extinction(rain)
    soft = soft_returns(fog, extinction) if fog else NO_FOG
    drop = drops(rain, extinction, divergence_rad, least_power) if rain else NO_DROPS
    return Air(2 * extinction, rain_range_noise(rain), *soft, *drop)


def through_air(
    distance: Floats, brightness: Floats, air: Air, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return (N,) distance and brightness of the strongest echo of each ray, and whether it is the air's own.

    The arguments are those in clear air: inf and 0 where a ray meets nothing.
    """
    rays = len(distance)
    brightest = rng.standard_exponential(rays, np.float32)  # drops above its power, on average
    place = rng.integers(SHARES, size=rays, dtype=np.uint8)
    behind = rng.integers(QUANTILES, size=rays, dtype=np.uint8)
    distance, brightness, aerial = distance.copy(), brightness.copy(), np.zeros(rays, np.bool_)
    _through_air(distance, brightness, aerial, air, brightest, place, behind)
    return distance, brightness, aerial


@compiled
def _through_air(distance, brightness, aerial, air, brightest, place, behind):
    last = len(air.soft_power) - 1
    reach = last * STEP_M
    for ray in range(len(distance)):
        surface = distance[ray]
        power = np.float32(0.0)
        if brightness[ray] > 0:
            brightness[ray] *= np.float32(np.exp(-air.two_way_per_m * surface))
            power = brightness[ray] / (surface * surface)
        entry = last if surface >= reach else int(surface / STEP_M)
        if air.soft_power[entry] > power:
            power = air.soft_power[entry]
            _answer(ray, air.soft_range_m[entry] + SPREAD_M[behind[ray]], power, surface, distance, brightness, aerial)
        if brightest[ray] < air.drop_number[-1]:
            level = np.searchsorted(air.drop_number, brightest[ray])
            if air.drop_power[level] > power and air.drop_range_m[level, place[ray]] < surface:
                power = air.drop_power[level]
                _answer(ray, air.drop_range_m[level, place[ray]], power, surface, distance, brightness, aerial)


@compiled
def _answer(ray, range_m, power, surface, distance, brightness, aerial):
    distance[ray] = min(range_m, surface)
    brightness[ray] = power * distance[ray] * distance[ray]
    aerial[ray] = True
