"""Fog, rain and snow between a LiDAR and what it hits: attenuation, backscatter, noise of ranges."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.special import betaincinv

from flcav.compiled import compiled
from flcav.world.weather import Weather

Floats = NDArray[np.float32]

PULSE_S = 20e-9
SEEN_FROM_M, SEEN_WHOLLY_M = 0.9, 1.0
SURFACE_PER_SR = 1e-6 / np.pi
STEP_M = 0.1
REACH_M = 16.0  # behind this, fog adds nothing to the peak
QUANTILES = 256
SPREAD_M = (10.0 * betaincinv(2.0, 20.0, (np.arange(QUANTILES) + 0.5) / QUANTILES)).astype(np.float32)
"""Quantiles of how far behind the peak a soft return is reported: 10 m * Beta(2, 20), as published with the paper."""


@lru_cache(maxsize=64)
def soft_returns(fog_per_m: float, extinction_per_m: float) -> tuple[Floats, Floats]:
    """Return the fog's largest power before a surface at each range, and the range [m] at which it is received.

    Both are (K,) float32; entry k is for a surface at k * STEP_M, the last for everything beyond. Power is relative to
    that from a white surface at 1 m. `fog_per_m` is the fog's own extinction, `extinction_per_m` that of all the air.
    """
    r = np.arange(0.0, REACH_M + STEP_M / 2, STEP_M)
    seen = np.clip((r - SEEN_FROM_M) / (SEEN_WHOLLY_M - SEEN_FROM_M), 0.0, 1.0)
    answer = seen * np.exp(-2 * extinction_per_m * r) / np.maximum(r, STEP_M) ** 2
    delay = 2 * (r[:, None] - r) / speed_of_light  # (received R, scattered r)
    pulse = np.where((delay >= 0) & (delay <= 2 * PULSE_S), np.sin(np.pi * delay / (2 * PULSE_S)) ** 2, 0.0)
    received = np.cumsum(pulse * answer, axis=1) * (2 * STEP_M / speed_of_light)  # (R, R0), integrated over t
    received = np.triu(received)  # not reported behind the surface
    backscatter = 0.046 * fog_per_m / np.log(20.0)
    power = received.max(axis=0) * backscatter / SURFACE_PER_SR
    return power.astype(np.float32), r[received.argmax(axis=0)].astype(np.float32)


N0 = 8000.0  # [1 / m^3 / mm]
DROP_REFLECTANCE = ((1.328 - 1) / (1.328 + 1)) ** 2  # of water, face on, at 905 nm
NEAREST_M = 1.5  # nearer drops are outside the receiver's view
FARTHEST_M = 40.0  # no drop farther away is ever bright enough
POWERS = 64
SHARES = 32


class Drops(NamedTuple):
    """The brightest drop in a beam of unlimited length."""

    number: NDArray[np.float32]  # (POWERS,) mean number of drops brighter than `power`, ascending
    power: NDArray[np.float32]  # (POWERS,) relative to a white surface at 1 m, descending
    range_m: NDArray[np.float32]  # (POWERS, SHARES) evenly spaced quantiles of the range of a drop of that power


def rain_extinction(rain_mm_h: float) -> float:
    """Return the extinction coefficient of rain [1/m]."""
    return 0.01 * rain_mm_h**0.6


def rain_range_noise(rain_mm_h: float) -> float:
    """Return the standard deviation of the measured range, as a share of the range."""
    return 0.02 * (1 - np.exp(-rain_mm_h)) ** 2


def drops(rain_mm_h: float, extinction_per_m: float, divergence_rad: float, least_power: float) -> Drops:
    """Return how bright drops are in rain of `rain_mm_h` > 0, down to `least_power`.

    `extinction_per_m` is that of everything in the air; the beam is as wide as `divergence_rad` times the range.
    """
    slope = 4.1 * rain_mm_h**-0.21  # L [1/mm]
    edges = np.linspace(NEAREST_M, FARTHEST_M, 512)
    r, dr = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    beam = np.tan(divergence_rad) * r
    brightest = DROP_REFLECTANCE * np.exp(-2 * extinction_per_m * r) / r**2  # of a drop as wide as the beam
    power = np.geomspace(max(brightest.max(), 2 * least_power), least_power, POWERS)
    share = power[:, None] / brightest  # of the beam that the drop fills
    thicker = N0 / slope * np.exp(-slope * 1e3 * beam * np.sqrt(share))  # drops per m^3 at least that bright
    count = np.where(share <= 1, thicker, 0.0) * np.pi / 4 * beam**2 * dr
    number = count.sum(axis=1)
    just = np.diff(count, axis=0, prepend=0.0)  # how many are that bright and no brighter, by range
    upto = np.cumsum(just, axis=1)
    wanted = (np.arange(SHARES) + 0.5) / SHARES
    ranges = [np.interp(wanted, row / row[-1], r) if row[-1] > 0 else np.full(SHARES, NEAREST_M) for row in upto]
    return Drops(number.astype(np.float32), power.astype(np.float32), np.array(ranges, np.float32))


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
