"""Beam patterns of LiDARs on the market, by name: `beams: <name>` in a rig.

They are from the makers' data sheets and manuals: Velodyne VLP-16 (63-9229), HDL-32E (97-0038), VLP-32C (63-9378),
HDL-64E (63-HDL64E), VLS-128 "Alpha Prime" (63-9679); Ouster OS0, OS1 and OS2 in their mode 1024x10, with beams that are
evenly spaced over the field of view; Hesai Pandar40P, Pandar64, Pandar128 and AT128, of which the last looks ahead by
120 degrees alone. All are at 10 spins per second, and elevations are nominal: those of a unit differ by some hundredths
of a degree. `waymo64` is like the LiDAR on the roof of the Waymo Open Dataset's cars (Sun et al., CVPR 2020: 64 beams,
2.4 to -17.6 degrees, 75 m); its beams lie closer together at the top than at the bottom, here by a parabola.
"""

from typing import NamedTuple

import numpy as np


class Beams(NamedTuple):
    """The beam pattern and range of a LiDAR model."""

    elevations_deg: tuple[float, ...]  # per channel, from the highest
    azimuth_steps: int  # firings per spin
    range_m: float  # maximum range [m]


def _even(high: float, low: float, count: int) -> tuple[float, ...]:
    return tuple(float(elevation) for elevation in np.linspace(high, low, count).round(3))


def _closer_above(high: float, low: float, count: int) -> tuple[float, ...]:
    """Return elevations whose spacing grows downwards, at the bottom to three times that at the top."""
    down = np.linspace(0.0, 1.0, count)
    return tuple(float(elevation) for elevation in (high + (low - high) * (down + down**2) / 2).round(3))


_HDL64E = (*_even(2.0, 2.0 - 31 / 3, 32), *_even(-8.83, -24.33, 32))  # an upper and a lower block of lasers
_VLP32C = (
    *(15.0, 10.333, 7.0, 4.667, 3.333, 2.333),
    *(1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667, -1.0, -1.333, -1.667, -2.0, -2.333, -2.667, -3.0, -3.333),
    *(-3.667, -4.0, -4.667, -5.333, -6.148, -7.254, -8.843, -11.31, -15.639, -25.0),
)
_VLS128 = (
    *(15.0, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98),
    *_even(4.83, -6.5, 104),
    *(-6.65, -6.85, -7.15, -7.65, -8.352, -9.244, -10.346, -11.742, -13.565, -16.042, -19.582, -25.0),
)
_PANDAR_TOP, _PANDAR_BOTTOM = (15.0, 11.0, 8.0, 5.0, 3.0), (*_even(-7.0, -14.0, 8), -19.0, -25.0)
_PANDAR128 = (15.0, *_even(14.0, 2.5, 24), *_even(2.0, -6.0, 65), *_even(-6.5, -24.5, 37), -25.0)

BEAMS: dict[str, Beams] = {
    "vlp16": Beams(_even(15.0, -15.0, 16), 1800, 100.0),
    "hdl32e": Beams(_even(10.67, -30.67, 32), 2170, 100.0),
    "vlp32c": Beams(_VLP32C, 1800, 200.0),
    "hdl64e": Beams(_HDL64E, 2083, 120.0),  # as on KITTI's car
    "vls128": Beams(_VLS128, 1800, 245.0),
    **{f"os0_{beams}": Beams(_even(45.0, -45.0, beams), 1024, 50.0) for beams in (32, 64, 128)},
    **{f"os1_{beams}": Beams(_even(22.5, -22.5, beams), 1024, 120.0) for beams in (32, 64, 128)},
    **{f"os2_{beams}": Beams(_even(11.25, -11.25, beams), 1024, 240.0) for beams in (32, 64, 128)},
    "pandar40": Beams((*_PANDAR_TOP, *_even(2.0, -6.0, 25), *_PANDAR_BOTTOM), 1800, 200.0),
    "pandar64": Beams((*_PANDAR_TOP, *_even(2.0, -6.0, 49), *_PANDAR_BOTTOM), 1800, 200.0),
    "pandar128": Beams(_PANDAR128, 1800, 200.0),
    "at128": Beams(_even(12.9, -12.5, 128), 3600, 200.0),
    "waymo64": Beams(_closer_above(2.4, -17.6, 64), 2650, 75.0),
}
