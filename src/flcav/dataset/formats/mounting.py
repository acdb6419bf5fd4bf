"""Estimation of how a LiDAR is mounted and how many beams it has, from its sweeps, where a log does not state it.

Sweeps in another frame than x ahead, y left, z up, in metres, are told by their ground, by where they have points, and
by how far these are.

The ground is the plane through the lowest points of cells near the LiDAR, fitted with a Cauchy loss (SciPy), so that
cars and kerbs do not pull it. Beams are counted by the median angle between neighbouring returns of a narrow sector,
one above the other, which hardly depends on where in the vehicle the points' frame has its origin.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from flcav.arrays import Array, Array32
from flcav.geometry.poses import pose

NEAR_M = (2.5, 20.0)  # distances of the ground that is fitted
CELL_M = 1.0
HEIGHTS_M = np.arange(-0.1, 3.6, 0.1)  # of a vehicle's LiDAR above the ground, or of a frame on the ground
CLOSE_M = 0.15  # distance from the plane of a point that counts as ground
CELLS, SHARE = 30, 0.4  # least number of cells, and share of them on the plane
SPREAD = 1.5  # least ratio of slopes of rays to the plane, which returns of a single beam do not have
SECTOR_DEG, APART_DEG = 0.4, 0.12  # width of a sector; returns less apart are of one beam
SEEN_M = (3.0, 60.0)  # distances of the returns that count beams
MADE = (16, 32, 40, 64, 128)  # numbers of beams that LiDARs are made with


@dataclass(frozen=True)
class Mounting:
    """The mounting of a LiDAR above the ground, and its number of beams."""

    height_m: float
    error_m: float  # standard deviation of the height over the sweeps; of one sweep, of its ground from the plane
    pitch_rad: float  # positive: the nose down, as in `flcav.geometry.pose`
    roll_rad: float
    beams: int
    sweeps: int  # number of sweeps that show ground

    @property
    def tilt_rad(self) -> float:
        """Return the angle between the LiDAR's vertical axis and that of the ground."""
        return float(np.hypot(self.pitch_rad, self.roll_rad))

    @property
    def agent_from_lidar(self) -> Array:
        """Return the pose (4, 4) [m] of the LiDAR in a vehicle whose origin is on the ground below it."""
        return pose(0.0, 0.0, self.height_m, 0.0, self.pitch_rad, self.roll_rad)


def estimate_mounting(clouds: Sequence[Array32]) -> Mounting | None:
    """Return the mounting of the LiDAR of sweeps (N, 4) x, y, z [m], intensity; None where most show no ground."""
    planes = np.array([plane for cloud in clouds if (plane := _fit_ground(cloud)) is not None]).reshape(-1, 4)
    if 2 * len(planes) <= len(clouds):
        return None
    at, ahead, left, uneven = planes.T
    normal = np.stack((-ahead, -left, np.ones_like(at))) / np.sqrt(1 + ahead**2 + left**2)
    height = -at * normal[2]
    error = height.std() if len(height) > 1 else uneven[0]
    # The rotation that makes the plane level has its normal as the third row: (-sin p, cos p sin r, cos p cos r).
    pitch, roll = np.arcsin(-normal[0]), np.arctan2(normal[1], normal[2])
    return Mounting(
        *(float(value) for value in (np.median(height), error, np.median(pitch), np.median(roll))),
        beams=_count_beams(clouds),
        sweeps=len(planes),
    )


UNITS = {100.0: "centimetres", 1000.0: "millimetres"}  # by their number in a metre
MEDIAN_M = 200.0  # median distance of a sweep's points that no LiDAR on a road measures
VERTICALS = {  # rotations to a frame with z up, by what points how in the file's
    "z points down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y points down, as in a camera's frame": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    "y points up": [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],
    "x points up": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "x points down": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
SIDES = {90: "y", 180: "-x", -90: "-y"}  # directions of the axes, counter-clockwise from x [deg]
SECTORS = 36  # of a turn, in which points are looked for
WANTED = "wanted are x ahead, y left, z up, in metres"


def find_other_frame(clouds: Sequence[Array32], *, placed: bool = False, grounded: bool = False) -> str:
    """Return what shows that sweeps (N, >= 3) are not in metres, x ahead, y left, z up; "" where nothing does.

    A sweep to all sides looks the same whichever way it is turned about z. `placed` LiDARs have a calibration, and may
    look to any side. `grounded`: most sweeps are known to show ground below the LiDAR.
    """
    clouds = [cloud for cloud in clouds if len(cloud)]
    if not clouds:
        return ""
    if grounded:
        return "" if placed else _find_side(clouds)
    median = float(np.median([np.median(np.linalg.norm(cloud[:, :3], axis=1)) for cloud in clouds]))
    if median > MEDIAN_M:
        units = [name for scale, name in UNITS.items() if _count_grounds([cloud / scale for cloud in clouds])]
        names = f", {units[0]} by the height of the ground" if units else ""
        return f"half of the points are farther than {median:.0f}, not metres{names}; {WANTED}"
    if 2 * _count_grounds(clouds) > len(clouds):
        return "" if placed else _find_side(clouds)
    for name, rotation in VERTICALS.items():
        turned = np.array(rotation, np.float32)
        if 2 * _count_grounds([cloud[:, :3] @ turned.T for cloud in clouds]) > len(clouds):
            return f"{name} by the ground; {WANTED}"
    return ""


def _count_grounds(clouds: Sequence[Array32]) -> int:
    """Return the number of sweeps (N, >= 3) that show ground below the LiDAR."""
    return sum(_fit_ground(cloud) is not None for cloud in clouds)


def _find_side(clouds: Sequence[Array32]) -> str:
    """Return to which side sweeps look that do not look ahead; "" for those that look ahead, or to all sides."""
    away = np.concatenate([cloud[:, :2].astype(np.float64) for cloud in clouds])
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    if len(np.unique(np.floor(azimuth * SECTORS / (2 * np.pi)))) > SECTORS / 2:
        return ""
    middle = float(np.degrees(np.angle(np.exp(1j * azimuth).mean())))
    side = min((0, *SIDES), key=lambda degrees: abs((middle - degrees + 180) % 360 - 180))
    return f"all points lie towards {SIDES[side]}, which must be ahead; {WANTED}" if side else ""


def _fit_ground(cloud: Array32) -> Array | None:
    """Return a, b, c of the ground z = a + b x + c y of a sweep and its unevenness [m], (4,); None without ground."""
    distance = np.hypot(cloud[:, 0], cloud[:, 1])
    near = cloud[(distance > NEAR_M[0]) & (distance < NEAR_M[1])].astype(np.float64)
    cell = np.floor(near[:, :2] / CELL_M)
    order = np.lexsort((near[:, 2], cell[:, 1], cell[:, 0]))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(cell[order], axis=0) != 0).any(axis=1)
    x, y, z = near[order][first][:, :3].T
    if len(z) < CELLS:
        return None
    counts = (np.abs(z[:, None] + HEIGHTS_M) < HEIGHTS_M[1] - HEIGHTS_M[0]).sum(axis=0)

    def differ(plane: Array) -> Array:
        return z - plane[0] - plane[1] * x - plane[2] * y

    fitted = least_squares(differ, [-HEIGHTS_M[counts.argmax()], 0.0, 0.0], loss="cauchy", f_scale=0.05)
    off = differ(fitted.x)
    on_it = np.abs(off) < CLOSE_M
    if on_it.sum() < max(CELLS, SHARE * len(z)) or not HEIGHTS_M[0] <= -fitted.x[0] <= HEIGHTS_M[-1]:
        return None
    low, high = np.percentile((np.abs(z) / np.hypot(x, y))[on_it], [10, 90])
    above = near[:, 2] - fitted.x[0] - near[:, :2] @ fitted.x[1:]
    most_above = (above > 2 * CLOSE_M).sum() >= (above < -2 * CLOSE_M).sum()
    return np.append(fitted.x, off[on_it].std()) if high >= SPREAD * low and most_above else None


def _count_beams(clouds: Sequence[Array32]) -> int:
    """Return the number in `MADE` that is nearest to the field of view over the angle between beams, plus one."""
    gaps, seen = [], []
    for cloud in clouds:
        distance = np.hypot(cloud[:, 0], cloud[:, 1])
        far = cloud[(distance > SEEN_M[0]) & (distance < SEEN_M[1])]
        above = np.degrees(np.arctan2(far[:, 2], np.hypot(far[:, 0], far[:, 1])))
        sector = np.floor(np.degrees(np.arctan2(far[:, 1], far[:, 0])) / SECTOR_DEG)
        order = np.lexsort((above, sector))
        apart = np.diff(above[order])
        gaps.append(apart[(np.diff(sector[order]) == 0) & (apart > APART_DEG)])
        seen.append(above)
    angles, between = np.concatenate(seen), np.concatenate(gaps)
    if not len(between):
        return MADE[-1]
    low, high = np.percentile(angles, [0.2, 99.8])
    return min(MADE, key=lambda beams: abs(np.log(beams / ((high - low) / np.median(between) + 1))))
