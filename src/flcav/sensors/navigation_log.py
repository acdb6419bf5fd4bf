"""Navigation logs: measurements of a vehicle's GNSS receiver and IMU over a whole drive, at the sensors' rates.

The vehicle moves along cubic splines through its poses at the steps of the traffic: positions and attitudes have
continuous rates and accelerations, so that integrating exact IMU measurements leads from pose to pose. (The velocity
and acceleration in a trace are SUMO's speed and its change, which differ from the derivatives of its positions.) Biases
are those of the sensors' samples in frames; white noise is drawn for the log. The rotation of the Earth is neglected.
"""

from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Mask
from flcav.geometry import rotations
from flcav.sensors.navigation import GRAVITY, Gnss, Imu, draw_fix_errors, draw_imu_errors
from flcav.sensors.rig import Rig
from flcav.statistics.streams import stream
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.map.parameters import GeoReference
from flcav.world.trace import Trace

GNSS_HZ = 10.0  # rate of fixes
SLACK_S = 1e-6  # tolerance in comparisons of times
LEAST_STEPS = 4  # steps of the traffic that the splines of a drive need


@dataclass(frozen=True)
class NavigationLog:
    """Measurements of a vehicle's first GNSS receiver and first IMU over a drive, with their error models."""

    gnss: str  # name of the receiver
    imu: str  # name of the IMU
    receiver: Gnss  # error model of the receiver
    unit: Imu  # error model of the IMU
    fix_time_s: Array  # (M,) ascending [s]
    fix: Array  # (M, 3) latitude [deg], longitude [deg], altitude [m], WGS 84
    imu_time_s: Array  # (N,) ascending [s]
    inertia: Array  # (N, 6) specific force [m/s^2] and angular rate [rad/s], IMU frame

    @property
    def begin_s(self) -> float:
        """Return the time from which both sensors measure [s]."""
        return float(max(self.fix_time_s[0], self.imu_time_s[0]))

    @property
    def end_s(self) -> float:
        """Return the time of the last sample of the IMU [s]."""
        return float(self.imu_time_s[-1])

    def covers(self, times_s: Array) -> Mask:
        """Return (T,) whether the times (T,) [s] are within the log, to a microsecond."""
        return (times_s >= self.begin_s - SLACK_S) & (times_s <= self.end_s + SLACK_S)


def log_drive(drives: Trace, agent: str, rig: Rig, geo: GeoReference, *, scene: str, seed: int) -> NavigationLog | None:
    """Simulate the navigation log of the vehicle `agent` over its drive, from when on it is always present.

    `drives` has its poses at every step of the traffic, `geo` is the position of the town's origin. None if the rig has
    no GNSS receiver or no IMU, or the drive has fewer than `LEAST_STEPS` steps.
    """
    from scipy.interpolate import CubicSpline  # imported late: they take a second
    from scipy.spatial.transform import Rotation, RotationSpline

    row = drives.actor.tolist().index(agent)
    begin = int(np.flatnonzero(~drives.present[:, row]).max(initial=-1)) + 1
    knots = drives.time_s[begin:]
    if not rig.gnss or not rig.imus or len(knots) < LEAST_STEPS:
        return None
    pitch, roll = np.zeros((2, len(knots))) if drives.tilt is None else drives.tilt[begin:, row].T
    way = CubicSpline(knots, drives.position[begin:, row])
    turn = RotationSpline(knots, Rotation.from_matrix(rotations(drives.yaw[begin:, row], pitch, roll)))
    (gnss, receiver), (imu, unit) = next(iter(rig.gnss.items())), next(iter(rig.imus.items()))

    def draw(sensor: str) -> tuple[np.random.Generator, np.random.Generator]:
        return stream(seed, scene, agent, sensor, "log"), stream(seed, scene, agent, sensor)

    at_s = _list_times(knots, GNSS_HZ)
    antenna = way(at_s) + turn(at_s).apply(receiver.mount.agent_from_sensor()[:3, 3])
    fix = convert_to_geodetic(geo, antenna + sum(draw_fix_errors(receiver.settings, at_s, *draw(gnss))))
    imu_s, mount = _list_times(knots, unit.settings.rate_hz), unit.mount.agent_from_sensor()
    rate, change = turn(imu_s, 1), turn(imu_s, 2)  # angular rate and acceleration, vehicle frame
    arm = np.broadcast_to(mount[:3, 3], rate.shape)
    lever = np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))
    force = turn(imu_s).inv().apply(way(imu_s, 2) - GRAVITY) + lever
    true = np.concatenate((force @ mount[:3, :3], rate @ mount[:3, :3]), axis=1)
    inertia = true + sum(draw_imu_errors(unit.settings, imu_s, *draw(imu)))
    return NavigationLog(gnss, imu, receiver.settings, unit.settings, at_s, fix, imu_s, inertia)


def _list_times(knots: Array, rate_hz: float) -> Array:
    """Return the sample times [s]: multiples of the period from the first to the last of `knots` [s]."""
    slack = SLACK_S * rate_hz
    return np.arange(np.ceil(knots[0] * rate_hz - slack), np.floor(knots[-1] * rate_hz + slack) + 1) / rate_hz
