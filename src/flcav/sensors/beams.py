"""Beams of LiDARs that people own, from their makers' data sheets, for `beams: <name>` in a rig.

Velodyne VLP-16 (63-9229), HDL-32E (97-0038), HDL-64E (63-HDL64E), VLS-128 "Alpha Prime" (63-9679) at 10 spins a second,
and Ouster OS1-128 in its mode 1024x10. Elevations are nominal: those of a unit differ by some hundredths of a degree.
"""

from typing import NamedTuple

import numpy as np


class Beams(NamedTuple):
    """What the name of a LiDAR stands for."""

    elevations_deg: tuple[float, ...]  # of each channel, from the highest
    azimuth_steps: int  # firings per spin
    range_m: float


def _even(high: float, low: float, count: int) -> tuple[float, ...]:
    return tuple(float(elevation) for elevation in np.linspace(high, low, count).round(3))


_HDL64E = (*_even(2.0, 2.0 - 31 / 3, 32), *_even(-8.83, -24.33, 32))  # an upper and a lower block of lasers
_VLS128 = (
    *(15.0, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98),
    *_even(4.83, -6.5, 104),
    *(-6.65, -6.85, -7.15, -7.65, -8.352, -9.244, -10.346, -11.742, -13.565, -16.042, -19.582, -25.0),
)

BEAMS: dict[str, Beams] = {
    "vlp16": Beams(_even(15.0, -15.0, 16), 1800, 100.0),
    "hdl32e": Beams(_even(10.67, -30.67, 32), 2170, 100.0),
    "hdl64e": Beams(_HDL64E, 2083, 120.0),  # as on KITTI's car
    "os1_128": Beams(_even(22.5, -22.5, 128), 1024, 120.0),
    "vls128": Beams(_VLS128, 1800, 245.0),
}
