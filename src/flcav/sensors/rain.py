"""Rain between a LiDAR and what it looks at: pulses get weaker, ranges get worse, near drops send echoes of their own.

Extinction and range noise after Goodin et al., "Predicting the Influence of Rain on LIDAR in ADAS", Electronics 8:89
(2019), eqs. 6 and 8. Drops after Kilic et al., "LISA", arXiv 2107.07004, section 3: Marshall-Palmer sizes
n(D) = N0 exp(-L D), each drop a sphere that fills the share (D / beam)^2 of the beam and reflects it as its Fresnel
reflectance says. LISA draws every drop of every beam; here the brightest drop's power is drawn from its distribution,
which is known in closed form: the number of drops brighter than P in a beam is Poisson with mean
m(P) = integral of (pi / 4) (b r)^2 n(D > D_P(r)) dr over the beam.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
