"""Fog between a LiDAR and what it looks at, after Hahner et al., "Fog Simulation on Real LiDAR Point Clouds for 3D
Object Detection in Adverse Weather", ICCV 2021.

With the extinction a = ln 20 / MOR and the backscattering b = 0.046 / MOR, a surface's echo is weaker by exp(-2 a R0)
(its eq. 7), and the fog before it answers with (eqs. 9 and 10)

    P(R) / P0' = b / b0 * integral over t in 0..2T of sin^2(pi t / 2T) x(r) exp(-2 a r) / r^2 U(R0 - r) dt,
    r = R - c t / 2,

where T = 20 ns is the pulse's half-power width, x rises linearly from 0 to 1 as the receiver comes to see the beam, and
b0 = 1e-6 / pi is the paper's differential reflectivity of a surface, here of a white one face on. The detector reports
the fog where P(R) is largest and larger than the surface's echo.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.special import betaincinv

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
