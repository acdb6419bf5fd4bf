"""Poses estimated from a navigation log: against the truth of drawn drives, and a factor graph of GTSAM."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flcav.config import InputError
from flcav.fusion.inertial import ACROSS_MPS, HEIGHT_M, UP_MPS, MotionEstimate, Mounts, estimate_drive
from flcav.geometry import inverse, pose, rotations, wrap_angle
from flcav.sensors.navigation import Gnss, Imu
from flcav.sensors.navigation_log import NavigationLog, log_drive
from flcav.sensors.rig import RIGS, Mount, MountedGnss, MountedImu, Rig
from flcav.world.geodesy import convert_to_map
from flcav.world.map.parameters import GeoReference
from flcav.world.trace import Trace

GEO = GeoReference(x_axis=(0.6, 0.8), y_axis=(-0.8, 0.6))
STEP_S = 0.1
LEVEL = np.zeros_like
AT_S = np.arange(12.0, 30.01, 0.2)


def drive(speed_mps: np.ndarray, yaw_rate: np.ndarray, heading: float = 0.5, slope: float = 0.0) -> Trace:
    """Return the trace of a car that moves along its heading, on a plane that rises by `slope` to the east."""
    fine = 20  # steps of the integration in each of the trace's
    time_s = np.arange(len(speed_mps), dtype=np.float64) * STEP_S
    inner = np.arange(0, time_s[-1] + 1e-9, STEP_S / fine)
    speed, turning = (np.interp(inner, time_s, each) for each in (speed_mps, yaw_rate))
    yaw = heading + np.concatenate(([0], np.cumsum((turning[1:] + turning[:-1]) / 2 * STEP_S / fine)))
    way = speed[:, None] * np.stack((np.cos(yaw), np.sin(yaw)), axis=1)
    place = np.concatenate((np.zeros((1, 2)), np.cumsum((way[1:] + way[:-1]) / 2 * STEP_S / fine, axis=0)))
    yaw, place = yaw[::fine], place[::fine]
    pitch, roll = -np.arctan(slope * np.cos(yaw)), np.arctan(slope * -np.sin(yaw)) * np.cos(np.arctan(slope))
    count = len(time_s)
    flat: Any = {name: np.zeros((count, 1, 3)) for name in ("velocity", "acceleration")}
    return Trace(
        town="plane",
        time_s=time_s,
        actor=np.array(["cav0"]),
        category=np.array(["car"]),
        shape=np.zeros(1, np.int64),
        size=np.array([[4.5, 1.8, 1.5]]),
        present=np.ones((count, 1), bool),
        position=np.column_stack((place, slope * place[:, 0]))[:, None],
        yaw=wrap_angle(yaw)[:, None],
        yaw_rate=np.zeros((count, 1)),
        light=np.zeros(0, np.str_),
        light_state=np.zeros((count, 0), np.str_),
        tilt=np.stack((pitch, roll), axis=1)[:, None] if slope else None,
        **flat,
    )


def city(seed: int = 0) -> Trace:
    """Return a drive of 30 s with bends, and a stop of 5 s."""
    rng, time_s = np.random.default_rng(seed), STEP_S * np.arange(301)
    knots = np.array([0, 4, 8, 11, 16, 20, 25, 30])
    speed = np.interp(time_s, knots, np.array([6, 10, 8, 0, 0, 7, 11, 5]) * rng.uniform(0.7, 1.3))
    turning = np.interp(time_s, knots, [0, 0, *rng.uniform(-0.3, 0.3, 1), 0, 0, *rng.uniform(-0.5, 0.5, 2), 0])
    smooth = np.ones(9) / 9
    smoothed = [np.convolve(np.pad(each, 4, "edge"), smooth, "valid") for each in (speed, turning)]
    return drive(smoothed[0], smoothed[1], rng.uniform(-3, 3))


def truth(trace: Trace, at_s: np.ndarray) -> np.ndarray:
    row = np.rint(at_s / STEP_S).astype(int)
    tilt = np.zeros((len(trace.time_s), 2)) if trace.tilt is None else trace.tilt[:, 0]
    out = np.tile(np.eye(4), (len(row), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = rotations(trace.yaw[row, 0], *tilt[row].T), trace.position[row, 0]
    return out


def rig_of(gnss: Gnss | None = None, imu: Imu | None = None, imu_mount: Mount | None = None) -> Rig:
    car = RIGS["car"]
    return car.model_copy(
        update={
            "gnss": {"gnss": MountedGnss(mount=Mount(x=-0.5, y=0.3, z=1.6), settings=gnss or Gnss())},
            "imus": {"imu": MountedImu(mount=imu_mount or Mount(x=0.8, z=0.5), settings=imu or Imu())},
        }
    )


def mounts_of(rig: Rig) -> Mounts:
    return Mounts(rig.gnss["gnss"].mount.agent_from_sensor(), rig.imus["imu"].mount.agent_from_sensor())


def log_of(trace: Trace, rig: Rig, seed: int = 0) -> NavigationLog:
    log = log_drive(trace, "cav0", rig, GEO, scene="s", seed=seed)
    assert log is not None
    return log


def estimate(trace: Trace, rig: Rig, seed: int = 0, at_s: np.ndarray = AT_S, slope: float = 0.0) -> MotionEstimate:
    return estimate_drive(log_of(trace, rig, seed), mounts_of(rig), GEO, lambda x, y: slope * x, at_s)


def errors(found: MotionEstimate, true: np.ndarray) -> np.ndarray:
    """Return the errors (T, 6) of position, world frame [m], and attitude, vehicle's axes [rad]."""
    between = np.swapaxes(found.world_from_agent[:, :3, :3], 1, 2) @ true[:, :3, :3]
    turned = Rotation.from_matrix(between).as_rotvec()
    return np.concatenate((true[:, :3, 3] - found.world_from_agent[:, :3, 3], turned), axis=1)


EXACT = rig_of(
    Gnss(noise_m=0, noise_up_m=0, bias_m=0, bias_up_m=0),
    Imu(force_noise=0, rate_noise=0, force_bias=0, rate_bias=0, force_walk=0, rate_walk=0),
    Mount(x=1.2, y=-0.4, z=0.6, yaw_deg=90, roll_deg=20),
)


@pytest.mark.parametrize("slope", [0.0, 0.08])
def test_exact_sensors_give_exact_poses(slope: float) -> None:
    flat = city()
    trace = drive(np.full(301, 8.0), np.full(301, 0.15), 2.0, slope) if slope else flat
    found = estimate(trace, EXACT, slope=slope)
    off = np.abs(errors(found, truth(trace, AT_S)))
    assert off[:, :3].max() < (0.08 if slope else 0.01)  # on the slope its speed is not quite along its pitch
    assert off[:, 3:].max() < np.radians(0.5 if slope else 0.05)


def test_the_imu_leads_from_pose_to_pose() -> None:
    """Strapdown integration of the samples alone, from the true state, follows the drive: lever, mount and gravity."""
    trace, start = drive(np.full(301, 8.0), 0.4 * np.sin(0.1 * np.arange(301)), 2.0, 0.08), 100
    log, mount = log_of(trace, EXACT), EXACT.imus["imu"].mount.agent_from_sensor()
    at = truth(trace, trace.time_s) @ mount
    turn, dt = at[start, :3, :3], 0.01
    place, velocity = at[start, :3, 3].copy(), (at[start + 1, :3, 3] - at[start - 1, :3, 3]) / (2 * STEP_S)
    for k in range(10 * start, 10 * start + 500):
        force, rate = np.split((log.inertia[k] + log.inertia[k + 1]) / 2, 2)
        half = Rotation.from_rotvec(rate * dt / 2).as_matrix()
        acceleration = turn @ half @ force + (0, 0, -9.80665)
        place += velocity * dt + acceleration * dt**2 / 2
        velocity = velocity + acceleration * dt
        turn = turn @ half @ half
    assert np.linalg.norm(place - at[start + 50, :3, 3]) < 0.05  # after 40 m
    assert np.degrees(Rotation.from_matrix(turn.T @ at[start + 50, :3, :3]).magnitude()) < 0.01


@pytest.mark.slow
def test_errors_are_what_the_covariance_says_and_small_between_near_frames() -> None:
    rig, rows, relative = rig_of(), [], []
    for seed in range(24):
        trace = city(seed)
        found, true = estimate(trace, rig, seed), truth(trace, AT_S)
        off = errors(found, true)
        rows.append(np.einsum("ti,ti->t", off, np.linalg.solve(found.covariance, off[..., None])[..., 0])[45])
        for i in range(len(AT_S) - 5):  # a second
            moved = [inverse(each[i]) @ each[i + 5] for each in (found.world_from_agent, true)]
            relative.append((*(moved[0] - moved[1])[:2, 3], np.arctan2(*(inverse(moved[0]) @ moved[1])[1::-1, 0])))
        np.testing.assert_allclose(found.world_from_agent[:, 3], np.tile((0, 0, 0, 1), (len(AT_S), 1)))
        assert 0.5 < found.deviation[:, 0].mean() < 1.3  # what remains of a bias of 1.2 m
    # of 24 independent drives: chi squared with 6 x 24 degrees of freedom; slip and height are less than is allowed for
    assert 2.0 < np.mean(rows) < 6 + 3.3 * np.sqrt(2 * 6 / 24)
    rms = np.sqrt(np.mean(np.square(relative), axis=0))
    assert (rms[:2] < 0.06).all()
    assert rms[2] < np.radians(0.05)


@pytest.mark.slow
def test_a_log_beyond_the_last_frame_is_used_for_it() -> None:
    """The smoothed pose of a frame is nearer to the truth than that from the log up to it."""
    off: dict[str, list[float]] = {"all": [], "past": []}
    for seed in range(8):
        trace = city(seed)
        rig = rig_of(Gnss(bias_m=0, bias_up_m=0))
        log, mounts = log_of(trace, rig, seed), mounts_of(rig)
        for name, until_s in (("all", 18.0), ("past", 13.0)):
            fixes, samples = log.fix_time_s <= until_s, log.imu_time_s <= until_s
            part = replace(
                log,
                fix_time_s=log.fix_time_s[fixes],
                fix=log.fix[fixes],
                imu_time_s=log.imu_time_s[samples],
                inertia=log.inertia[samples],
            )
            at_s = np.array([13.0])
            found = estimate_drive(part, mounts, GEO, lambda x, y: 0 * x, at_s)
            off[name].append(float(np.square(errors(found, truth(trace, at_s))[0, :2]).sum()))
    assert np.mean(off["all"]) < np.mean(off["past"])


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_a_heading_is_known_of_cars_that_move(speed: float) -> None:
    trace = drive(np.full(301, speed), np.zeros(301), heading=2.8)
    found = estimate(trace, rig_of())
    heading = np.degrees(found.deviation[:, 1])
    off = np.degrees(np.abs(wrap_angle(np.arctan2(*found.world_from_agent[:, 1::-1, 0].T) - 2.8)))
    assert (heading > 30).all() if not speed else (heading < 2).all()
    assert (off < 4 * heading).all()
    if not speed:
        assert np.ptp(found.world_from_agent[:, :2, 3], axis=0).max() < 0.02  # it stands, wherever that is


def test_poses_are_found_between_samples() -> None:
    """A slow IMU, and frames at times of their own."""
    trace, rig = city(), rig_of(imu=Imu(rate_hz=33.0, force_noise=0, rate_noise=0, force_bias=0, rate_bias=0))
    found = estimate(
        trace, rig_of(Gnss(noise_m=0.01, noise_up_m=0.01, bias_m=0, bias_up_m=0), rig.imus["imu"].settings)
    )
    assert np.abs(errors(found, truth(trace, AT_S))[:, :2]).max() < 0.05


def test_a_factor_graph_finds_the_same_poses() -> None:
    """GTSAM's preintegrated IMU factors, with fixes and a car's constraints as factors of their own."""
    gtsam = pytest.importorskip("gtsam")
    receiver = Gnss(bias_m=0, bias_up_m=0)
    rig = rig_of(receiver, Imu(force_walk=0.01, rate_walk=0.001))  # or its numbers are too far apart
    trace = drive(8 + np.sin(0.05 * np.arange(81)), 0.3 * np.sin(0.08 * np.arange(81)))
    log, mounts, at_s = log_of(trace, rig, 3), mounts_of(rig), np.arange(0.0, 8.01, 0.1)
    found = estimate_drive(log, mounts, GEO, lambda x, y: 0 * x, at_s)

    unit, graph, values = log.unit, gtsam.NonlinearFactorGraph(), gtsam.Values()
    lever, antenna = mounts.agent_from_imu[:3, 3], mounts.agent_from_gnss[:3, 3] - mounts.agent_from_imu[:3, 3]
    about = gtsam.PreintegrationCombinedParams.MakeSharedU(9.80665)
    about.setAccelerometerCovariance(unit.force_noise**2 / 2 * np.eye(3))  # one-sided densities
    about.setGyroscopeCovariance(unit.rate_noise**2 / 2 * np.eye(3))
    about.setBiasAccCovariance(unit.force_walk**2 * np.eye(3))
    about.setBiasOmegaCovariance(unit.rate_walk**2 * np.eye(3))
    about.setIntegrationCovariance(1e-6 * np.eye(3))
    x, v, b = (lambda k, letter=letter: gtsam.symbol(letter, k) for letter in "xvb")
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    seen, none = convert_to_map(GEO, log.fix), gtsam.imuBias.ConstantBias()

    def numerical(error: Any, keys: list[int], sigmas: list[float], graph: Any = graph) -> None:
        def factor(_: Any, at: Any, jacobians: Any) -> np.ndarray:
            parts = [at.atPose3(keys[0]), *((at.atVector(keys[1]),) if len(keys) > 1 else ())]
            out = error(*parts)
            if jacobians is None:
                return out
            for i, part in enumerate(parts):
                width = 6 if i == 0 else 3
                columns: list[np.ndarray] = []
                for step in 1e-6 * np.eye(width):
                    moved = [parts[0].retract(step) if i == 0 else parts[0], *parts[1:]]
                    if i:
                        moved[1] = part + step
                    columns.append((error(*moved) - out) / 1e-6)
                jacobians[i] = np.asfortranarray(np.stack(columns, axis=1))
            return out

        graph.add(gtsam.CustomFactor(diagonal(np.array(sigmas)), keys, factor))

    for k in range(len(at_s)):
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = (
            found.world_from_agent[k][:3, :3],
            found.world_from_agent[k][:3, 3] + (0.5, -0.5, lever[2]),
        )
        values.insert(x(k), gtsam.Pose3(start @ pose(0, 0, 0, 0.1)))
        values.insert(v(k), 7.0 * found.world_from_agent[k][:3, 0])
        values.insert(b(k), none)
        numerical(
            lambda at, k=k: at.translation() + at.rotation().matrix() @ antenna - seen[k],
            [x(k)],
            [receiver.noise_m, receiver.noise_m, receiver.noise_up_m],
        )
        numerical(lambda at: (at.translation() - at.rotation().matrix() @ lever)[2:], [x(k)], [HEIGHT_M])
        rate = log.inertia[10 * k, 3:]
        numerical(  # the gyroscope's bias moves the origin's velocity by a millimetre a second
            lambda at, speed, rate=rate: (at.rotation().matrix().T @ speed - np.cross(rate, lever))[1:],
            [x(k), v(k)],
            [ACROSS_MPS, UP_MPS],
        )
        if k:
            summed = gtsam.PreintegratedCombinedMeasurements(about, none)
            for i in range(10 * k - 10, 10 * k):
                force, turning = np.split((log.inertia[i] + log.inertia[i + 1]) / 2, 2)
                summed.integrateMeasurement(force, turning, 0.01)
            graph.add(gtsam.CombinedImuFactor(x(k - 1), v(k - 1), x(k), v(k), b(k - 1), b(k), summed))
    spread = diagonal(np.repeat((unit.force_bias, unit.rate_bias), 3))
    graph.add(gtsam.PriorFactorConstantBias(b(0), none, spread))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, best)
    for k in range(0, len(at_s), 10):
        own, other = (
            found.world_from_agent[k],
            best.atPose3(x(k)).matrix() @ inverse(mounts.agent_from_imu) @ pose(0, 0),
        )
        other = best.atPose3(x(k)).matrix() @ pose(*-lever)
        stated = found.deviation[k]
        assert np.abs(own[:2, 3] - other[:2, 3]).max() < 0.3 * stated[0]
        assert (
            abs(wrap_angle(np.arctan2(own[1, 0], own[0, 0]) - np.arctan2(other[1, 0], other[0, 0]))) < 0.3 * stated[1]
        )
        theirs = marginals.marginalCovariance(x(k))  # rotation, then translation, vehicle's axes
        assert stated[1] == pytest.approx(np.sqrt(theirs[2, 2]), rel=0.15)
        assert stated[0] == pytest.approx(np.sqrt((theirs[3, 3] + theirs[4, 4]) / 2), rel=0.15)


def test_logs_that_say_nothing_of_a_frame_are_refused() -> None:
    trace, rig = city(), rig_of()
    with pytest.raises(InputError, match=r"the navigation log goes from -?0.0 to 30.0 s, and a frame is at 30.5 s"):
        estimate(trace, rig, at_s=np.array([10.0, 30.5]))
    log, other = log_of(trace, rig), log_of(drive(np.full(301, 12.0), np.full(301, -0.2)), rig)
    with pytest.raises(InputError, match="the fixes of the navigation log are not where its IMU leads"):
        estimate_drive(replace(log, fix=other.fix), mounts_of(rig), GEO, lambda x, y: 0 * x, AT_S)
    late = replace(log, fix_time_s=log.fix_time_s - 29.95)
    with pytest.raises(InputError, match="no two fixes while its IMU measures"):
        estimate_drive(late, mounts_of(rig), GEO, lambda x, y: 0 * x, AT_S)
