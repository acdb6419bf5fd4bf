"""Fog and rain in front of a LiDAR: extinction, backscatter of fog, returns from drops, range noise.

Fog after Hahner et al., "Fog Simulation on Real LiDAR Point Clouds for 3D Object Detection in Adverse Weather", ICCV
2021. With the extinction a = ln 20 / MOR and the backscattering b = 0.046 / MOR (MOR: meteorological optical range),
the return of a surface at R0 is attenuated by exp(-2 a R0) (eq. 7), and the fog in front of it returns (eqs. 9 and 10)

    P(R) / P0' = b / b0 * integral over t in 0..2T of sin^2(pi t / 2T) x(r) exp(-2 a r) / r^2 U(R0 - r) dt,
    r = R - c t / 2,

where T = 20 ns is the pulse's half-power width, x(r) rises linearly from 0 to 1 as the beam enters the receiver's field
of view, and b0 = 1e-6 / pi is the paper's differential reflectivity of a surface, here of a white one at normal
incidence. The fog's return is at the R of the largest P(R), and is detected where it exceeds that of the surface.

Extinction and range noise of rain after Goodin et al., "Predicting the Influence of Rain on LIDAR in ADAS", Electronics
8:89 (2019), eqs. 6 and 8. Returns from drops after Kilic et al., "LISA", arXiv 2107.07004, section 3: Marshall-Palmer
sizes n(D) = N0 exp(-L D), each drop a sphere that fills the share (D / beam)^2 of the beam and reflects it by its
Fresnel reflectance. LISA draws every drop of every beam; here the power of the brightest drop is drawn from its
distribution in closed form: the number of drops in a beam that are brighter than P is Poisson with the mean
m(P) = integral of (pi / 4) (b r)^2 n(D > D_P(r)) dr over the beam.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.constants import speed_of_light
from scipy.special import betaincinv

from flcav.arrays import Array32, Mask
from flcav.machine.compiled import compiled
from flcav.world.weather import Weather

PULSE_S = 20e-9  # T, half-power width of the pulse
SEEN_FROM_M, SEEN_WHOLLY_M = 0.9, 1.0  # ranges where the receiver's overlap x(r) leaves 0 and reaches 1
SURFACE_PER_SR = 1e-6 / np.pi  # b0
STEP_M = 0.1  # step of ranges in the tables of fog
REACH_M = 16.0  # range beyond which fog does not raise the peak
QUANTILES = 256  # of the tabulated distribution below
SPREAD_M = (10.0 * betaincinv(2.0, 20.0, (np.arange(QUANTILES) + 0.5) / QUANTILES)).astype(np.float32)
"""Quantiles of how far behind the peak a soft return is reported: 10 m * Beta(2, 20), as published with the paper."""

N0 = 8000.0  # intercept of Marshall and Palmer's drop sizes [1 / m^3 / mm]
DROP_REFLECTANCE = ((1.328 - 1) / (1.328 + 1)) ** 2  # Fresnel reflectance of water at normal incidence, 905 nm
NEAREST_M = 1.5  # nearer drops are outside the receiver's field of view
FARTHEST_M = 40.0  # drops farther away are never bright enough
POWERS = 64  # rows of the table of powers
SHARES = 32  # quantiles of range per power
NO_FOG = np.zeros(1, np.float32), np.zeros(1, np.float32)


@lru_cache(maxsize=64)
def compute_fog_returns(fog_per_m: float, extinction_per_m: float) -> tuple[Array32, Array32]:
    """Return the peak power of the return of fog in front of a surface, and the peak's range [m], by surface range.

    Both are (K,) float32; entry k is for a surface at k * STEP_M, the last for all ranges beyond. Power is relative to
    that of a white surface at 1 m. `fog_per_m` is the extinction [1/m] of fog only, `extinction_per_m` of fog and rain.
    Source: Hahner et al., eqs. 9 and 10.
    """
    r = np.arange(0.0, REACH_M + STEP_M / 2, STEP_M)
    seen = np.clip((r - SEEN_FROM_M) / (SEEN_WHOLLY_M - SEEN_FROM_M), 0.0, 1.0)
    answer = seen * np.exp(-2 * extinction_per_m * r) / np.maximum(r, STEP_M) ** 2
    delay = 2 * (r[:, None] - r) / speed_of_light  # (received R, scattered r)
    pulse = np.where((delay >= 0) & (delay <= 2 * PULSE_S), np.sin(np.pi * delay / (2 * PULSE_S)) ** 2, 0.0)
    received = np.cumsum(pulse * answer, axis=1) * (2 * STEP_M / speed_of_light)  # (R, R0), integrated over t
    received = np.triu(received)  # fog behind the surface does not return
    backscatter = 0.046 * fog_per_m / np.log(20.0)
    power = received.max(axis=0) * backscatter / SURFACE_PER_SR
    return power.astype(np.float32), r[received.argmax(axis=0)].astype(np.float32)


class Drops(NamedTuple):
    """Distribution of the power and range of the brightest rain drop in a beam of unlimited length."""

    number: Array32  # (POWERS,) mean number of drops brighter than `power`, ascending
    power: Array32  # (POWERS,) relative to that of a white surface at 1 m, descending
    range_m: Array32  # (POWERS, SHARES) evenly spaced quantiles of the range of a drop of that power


def rain_extinction(rain_mm_h: float) -> float:
    """Return the extinction coefficient of rain [1/m] (Goodin et al., eq. 6)."""
    return 0.01 * rain_mm_h**0.6


def rain_range_noise(rain_mm_h: float) -> float:
    """Return the standard deviation of the measured range, relative to the range (Goodin et al., eq. 8)."""
    return 0.02 * (1 - np.exp(-rain_mm_h)) ** 2


def compute_drops(rain_mm_h: float, extinction_per_m: float, divergence_rad: float, least_power: float) -> Drops:
    """Return the distribution of the brightest drop in rain, `rain_mm_h` > 0 [mm/h], for powers from `least_power` on.

    `extinction_per_m` [1/m] is that of fog and rain, the beam's width is `divergence_rad` times the range (LISA).
    """
    slope = 4.1 * rain_mm_h**-0.21  # L [1/mm]
    edges = np.linspace(NEAREST_M, FARTHEST_M, 512)
    r, dr = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    beam = np.tan(divergence_rad) * r
    brightest = DROP_REFLECTANCE * np.exp(-2 * extinction_per_m * r) / r**2  # return of a drop that fills the beam
    power = np.geomspace(max(brightest.max(), 2 * least_power), least_power, POWERS)
    share = power[:, None] / brightest  # of the beam that the drop fills
    thicker = N0 / slope * np.exp(-slope * 1e3 * beam * np.sqrt(share))  # drops per m^3 of at least that power
    count = np.where(share <= 1, thicker, 0.0) * np.pi / 4 * beam**2 * dr
    number = count.sum(axis=1)
    just = np.diff(count, axis=0, prepend=0.0)  # drops between this power and the next higher one, by range
    upto = np.cumsum(just, axis=1)
    wanted = (np.arange(SHARES) + 0.5) / SHARES
    ranges = [np.interp(wanted, row / row[-1], r) if row[-1] > 0 else np.full(SHARES, NEAREST_M) for row in upto]
    return Drops(number.astype(np.float32), power.astype(np.float32), np.array(ranges, np.float32))


NO_DROPS = Drops(np.zeros(1, np.float32), np.zeros(1, np.float32), np.zeros((1, SHARES), np.float32))


class Air(NamedTuple):
    """The effect of fog and rain on a LiDAR's beams; powers are relative to that of a white surface at 1 m."""

    two_way_per_m: float  # twice the extinction coefficient
    range_noise: float  # standard deviation of the measured range, relative to the range
    soft_power: Array32  # (K,) peak of the return of fog in front of a surface at k * STEP_M; zero without fog
    soft_range_m: Array32  # (K,) range of that peak [m]
    drop_number: Array32  # (L,) mean number of drops in a beam brighter than `drop_power`; zero without rain
    drop_power: Array32  # (L,) descending
    drop_range_m: Array32  # (L, SHARES) quantiles of a drop's range [m]


def compute_air(weather: Weather, divergence_rad: float, least_power: float) -> Air | None:
    """Return the effect of fog and rain in `weather`; None without fog and rain.

    A beam's width is `divergence_rad` times the range; drops with a return below `least_power` are left out.
    """
    rain, fog = weather.rain_mm_h, weather.fog_per_m
    if rain == 0 and fog == 0:
        return None
    extinction = fog + rain_extinction(rain)
    soft = compute_fog_returns(fog, extinction) if fog else NO_FOG
    drop = compute_drops(rain, extinction, divergence_rad, least_power) if rain else NO_DROPS
    return Air(2 * extinction, rain_range_noise(rain), *soft, *drop)


def add_air_returns(
    distance: Array32, brightness: Array32, air: Air, rng: np.random.Generator
) -> tuple[Array32, Array32, Mask]:
    """Return (N,) distances [m] and brightnesses of the strongest returns of N rays, and whether fog or rain sent them.

    `distance` and `brightness` (N,) are those in clear air: inf and 0 for a ray without a hit. Brightness is power
    times squared distance: 1 for a white surface at normal incidence.
    """
    rays = len(distance)
    # The number of drops brighter than P is Poisson with the mean m(P), so m of the brightest drop's power is
    # exponentially distributed: no drop needs to be drawn.
    brightest = rng.standard_exponential(rays, np.float32)
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
