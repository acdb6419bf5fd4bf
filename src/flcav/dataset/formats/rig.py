"""The LiDAR of sweeps whose files do not say how it is mounted: the usual one, unless the sweeps show another.

In a folder of KITTI's layout the usual LiDAR is KITTI's own, an HDL-64E, 1.73 m above the ground and level (Geiger et
al., IJRR 32(11), 2013, section 2 and fig. 3); for other sweeps it is the one that a network expects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.arrays import Array, Array32
from flcav.config import InputError
from flcav.dataset.formats.mounting import Mounting, estimate_mounting, find_other_frame
from flcav.geometry.poses import pose
from flcav.interface.wording import plural

HEIGHT_M, BEAMS, RANGE_M = 1.73, 64, 120.0
OTHER_M, OTHER_RAD = 0.15, 0.05  # differences in height and direction that make another mounting
LOOKED, ENOUGH = 20, 5  # sweeps that are looked at, and that are needed to tell a tilt from the slope of a street
STEEP_RAD = 0.1  # tilt that no slope within 20 m of a vehicle has, so that one sweep tells it
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
class UsualLidar:
    """The LiDAR that sweeps are taken to be of, unless they show another."""

    whose: str  # possessive, as "KITTI's"
    height_m: float  # above the ground
    beams: int | None = None  # None: any number


KITTI = UsualLidar("KITTI's", HEIGHT_M, BEAMS)


@dataclass(frozen=True)
class LidarRig:
    """The mount and the beams of a LiDAR, and sentences on how they differ from the usual ones."""

    agent_from_lidar: Array  # (4, 4) [m]; the vehicle's origin is on the ground below the LiDAR
    beams: int | None  # None: unknown
    notes: tuple[str, ...] = ()


def find_rig(
    sweeps: Sequence[Path],
    read: Callable[[Path], Array32],
    stated: StatedLidar = UNSTATED,
    usual: UsualLidar = KITTI,
) -> LidarRig:
    """Return the LiDAR of sweeps by those of them that are evenly spread.

    Raises `InputError` where a file is damaged, and where the points are in another frame than x ahead, y left, z up,
    or not in metres.

    Args:
        sweeps: the files of the sweeps.
        read: function that returns the points (N, 4) x, y, z [m], intensity of a file.
        stated: height and beams that the user states; by default as the sweeps show.
        usual: the LiDAR that the sweeps are taken to be of, unless they show another.
    """
    chosen = sorted({sweeps[round(i)] for i in np.linspace(0, len(sweeps) - 1, LOOKED)}) if sweeps else []
    clouds = [read(path) for path in chosen]
    found = estimate_mounting(clouds)
    if other := find_other_frame(clouds, grounded=found is not None):
        raise InputError(f"{chosen[0] if len(chosen) == 1 else chosen[0].parent}: {other}")
    beams = stated.beams or (usual.beams if found is None else found.beams)
    notes = list[str]()
    if stated.beams is None and usual.beams is not None and beams != usual.beams:
        notes.append(f"some {beams} beams by the angles between returns, not {usual.whose} {usual.beams}")
    if found is None:
        mount = pose(0.0, 0.0, stated.height_m or usual.height_m)
        if chosen and stated.height_m is None:
            seen = plural(len(chosen), "sweep")
            where = "most of " * (len(chosen) > 1) + seen
            notes.append(f"no ground near the LiDAR in {where}, so it is taken to be {usual.height_m:g} m above it")
    else:
        mount, note = _place(found, stated, usual)
        notes += [note] if note else []
    return LidarRig(mount, beams, tuple(notes))


def _place(found: Mounting, stated: StatedLidar, usual: UsualLidar) -> tuple[Array, str]:
    """Return the mount (4, 4) [m] by the ground and what is stated, and how it differs from the usual, in words."""
    tilted = found.tilt_rad > (OTHER_RAD if found.sweeps >= ENOUGH else STEEP_RAD)
    other = tilted or abs(found.height_m - usual.height_m) > max(OTHER_M, 2 * found.error_m)
    height_m = stated.height_m or (found.height_m if other else usual.height_m)
    angles = (found.pitch_rad, found.roll_rad) if tilted else (0.0, 0.0)
    notes = []
    if other and stated.height_m is None:
        seen = plural(found.sweeps, "sweep")
        apart = f"{height_m:.2f} m (+- {found.error_m:.2f})"
        notes.append(
            f"the ground of {seen} lies {apart} below the LiDAR, not {usual.whose} {usual.height_m:g} m (corrected)"
        )
    if tilted:
        notes.append(f"the LiDAR is tilted by {np.degrees(found.tilt_rad):.0f} degrees against it (corrected)")
    return pose(0.0, 0.0, height_m, 0.0, *angles), ", and ".join(notes)
