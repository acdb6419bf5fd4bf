"""The LiDAR of a folder in KITTI's layout: KITTI's own, unless its sweeps show that it is another.

KITTI's is an HDL-64E, 1.73 m above the ground and level (Geiger et al., IJRR 32(11), 2013, section 2 and fig. 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError
from flcav.dataset.formats.kitti.files import read_points
from flcav.dataset.formats.mounting import Mounting, estimate_mounting
from flcav.geometry.poses import pose
from flcav.interface.wording import plural

HEIGHT_M, BEAMS, RANGE_M = 1.73, 64, 120.0
OTHER_M, OTHER_RAD = 0.15, 0.05  # differences in height and direction that make another mounting
LOOKED, ENOUGH = 20, 5  # sweeps that are looked at, and that are needed to tell a tilt from the slope of a street
HEIGHTS_M, MOST_BEAMS = (0.2, 10.0), 1024


@dataclass(frozen=True)
class StatedLidar:
    """Height and beams of a LiDAR as the user states them; raises `InputError` for impossible ones."""

    height_m: float | None = None  # above the ground
    beams: int | None = None

    def __post_init__(self) -> None:
        low, high = HEIGHTS_M
        if self.height_m is not None and not low <= self.height_m <= high:
            raise InputError(f"--lidar-height {self.height_m:g}: from {low:g} to {high:g} m are wanted")
        if self.beams is not None and not 1 <= self.beams <= MOST_BEAMS:
            raise InputError(f"--beams {self.beams}: from 1 to {MOST_BEAMS} are wanted")


UNSTATED = StatedLidar()


@dataclass(frozen=True)
class KittiRig:
    """The mount and the beams of a folder's LiDAR, and sentences on how they differ from KITTI's."""

    agent_from_lidar: Array  # (4, 4) [m]; the vehicle's origin is on the ground below the LiDAR
    beams: int
    notes: tuple[str, ...] = ()


def find_rig(sweeps: Sequence[Path], stated: StatedLidar = UNSTATED) -> KittiRig:
    """Return the LiDAR of sweeps by those of them that are evenly spread; raises `InputError` where one is damaged."""
    chosen = sorted({sweeps[round(i)] for i in np.linspace(0, len(sweeps) - 1, LOOKED)}) if sweeps else []
    found = estimate_mounting([read_points(path) for path in chosen])
    beams = stated.beams or (BEAMS if found is None else found.beams)
    notes = list[str]()
    if stated.beams is None and beams != BEAMS:
        notes.append(f"some {beams} beams by the angles between returns, not KITTI's {BEAMS}")
    if found is None:
        mount = pose(0.0, 0.0, stated.height_m or HEIGHT_M)
        if chosen and stated.height_m is None:
            seen = plural(len(chosen), "sweep")
            notes.append(f"no ground near the LiDAR in most of {seen}, so it is taken to be {HEIGHT_M:g} m above it")
    else:
        mount, note = _place(found, stated)
        notes += [note] if note else []
    return KittiRig(mount, beams, tuple(notes))


def _place(found: Mounting, stated: StatedLidar) -> tuple[Array, str]:
    """Return the mount (4, 4) [m] by the ground and what is stated, and how it differs from KITTI's, in words."""
    tilted = found.sweeps >= ENOUGH and found.tilt_rad > OTHER_RAD
    other = tilted or abs(found.height_m - HEIGHT_M) > max(OTHER_M, 2 * found.error_m)
    height_m = stated.height_m or (found.height_m if other else HEIGHT_M)
    angles = (found.pitch_rad, found.roll_rad) if tilted else (0.0, 0.0)
    notes = []
    if other and stated.height_m is None:
        seen = plural(found.sweeps, "sweep")
        apart = f"{height_m:.2f} m (+- {found.error_m:.2f})"
        notes.append(f"the ground of {seen} lies {apart} below the LiDAR, not KITTI's {HEIGHT_M:g} m (corrected)")
    if tilted:
        notes.append(f"the LiDAR is tilted by {np.degrees(found.tilt_rad):.0f} degrees against it (corrected)")
    return pose(0.0, 0.0, height_m, 0.0, *angles), ", and ".join(notes)
