"""GNSS-aided inertial navigation of a car: an error-state Kalman filter over a drive, and an RTS smoother.

The nominal state (position and velocity of the IMU, attitude of the vehicle, biases) is integrated from the IMU's
samples by the midpoint rule; the error state has 18 components: position and velocity in the world, attitude in the
vehicle's axes, biases of specific force and angular rate, and the GNSS receiver's bias (Solà, "Quaternion kinematics
for the error-state Kalman filter", 2017, eq. 235-238 and 260-270). Measurements, `RATE_HZ` times a second:

- a fix: position of the antenna plus the receiver's bias, a first-order Gauss-Markov process. Only the sum of position
  and bias is observable: the remaining bias is in the covariance, and nearly the same in consecutive frames;
- non-holonomic constraints: lateral and vertical velocity of the vehicle's origin are 0 (Dissanayake et al., "The
  aiding of a low-cost strapdown inertial measurement unit using vehicle model constraints for land vehicle
  applications", IEEE T-RA 17(5), 2001). In SUMO a car's middle moves along its heading, as the rear axle of a real car
  does;
- zero-velocity updates: at rest velocity and angular rate are 0 (Groves, "Principles of GNSS, inertial, and multisensor
  integrated navigation systems", 2nd ed. 2013, 15.3), where the IMU's variation and the filter's speed are small;
- the map: the car stands on the ground, whose height is known except on and below bridges.

Labels are made after the drive, so that a pose may depend on later measurements: Rauch, Tung and Striebel, "Maximum
likelihood estimates of linear dynamic systems", AIAA Journal 3(8), 1965. The Earth is flat and does not turn.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError
from flcav.geometry import rotations_about_z
from flcav.sensors.navigation import GRAVITY
from flcav.sensors.navigation_log import NavigationLog
from flcav.world.geodesy import convert_to_map
from flcav.world.map.parameters import GeoReference

Nominal = tuple[Array, Array, Array, Array]  # position, velocity, turn and bias as in `_States`, by heading (H, ...)
STATES = 18  # position, velocity, attitude, biases of force, of rate, and of the receiver: 3 each
ACROSS_MPS, UP_MPS = 0.2, 0.2  # standard deviations of a car's lateral and vertical velocity, vehicle's axes
REST_MPS, REST_RADPS = 0.02, 0.001  # standard deviations of velocity and angular rate at rest
SLOW_MPS = 1.0  # greatest speed of a vehicle that may be at rest
QUIET_S, QUIET = 1.0, 2.0  # and the greatest variation of its IMU, in standard deviations, this time before and after
HEIGHT_M = 0.5  # standard deviation of the height of the map's ground below a fix
HEADINGS = 8  # initial headings that are tried
BACKWARDS_M = 1.0  # greatest net distance that a car drives backwards
LEAST_WEIGHT = 1e-4  # of an initial heading that counts, relative to all
BEGIN_M, BEGIN_MPS, BEGIN_TILT_RAD = 10.0, 2.0, 0.08  # initial standard deviations
LEAST_SAMPLE, LEAST_FIX_M = (3e-3, 1e-4), 0.01  # least noise of an IMU's samples, [m/s^2] and [rad/s], and of fixes
LEAST_BIAS = 1e-6  # least initial standard deviation of a bias, [m/s^2], [rad/s] or [m]
IMPOSSIBLE = 10.0  # mean normalised squared innovation of fixes, in 3 dimensions, above which fixes and IMU disagree


@dataclass(frozen=True)
class MotionEstimate:
    """Estimated poses of a vehicle at T times, and their covariance."""

    world_from_agent: Array  # (T, 4, 4) [m]
    covariance: Array  # (T, 6, 6) of position [m], world frame, and attitude [rad], vehicle's axes

    @property
    def deviation(self) -> Array:
        """Return the standard deviations (T, 2) of position, along x and y [m], and heading [rad]."""
        turn = self.world_from_agent[:, :3, :3]
        heading = np.einsum("ti,tij,tj->t", turn[:, 2], self.covariance[:, 3:, 3:], turn[:, 2])
        return np.sqrt(np.stack((self.covariance[:, (0, 1), (0, 1)].mean(axis=1), heading), axis=1))


class Mounts(NamedTuple):
    """Mounts of a vehicle's sensors in its frame, as it assumes them."""

    agent_from_gnss: Array  # (4, 4) [m]
    agent_from_imu: Array  # (4, 4) [m]


class _States(NamedTuple):
    """The states at E epochs: nominal states, and the covariances of their errors."""

    position: Array  # (E, 3) of the IMU [m], world frame
    velocity: Array  # (E, 3) of the IMU [m/s], world frame
    turn: Array  # (E, 3, 3) world from vehicle
    bias: Array  # (E, 9) of force [m/s^2] and rate [rad/s], vehicle's axes, and of the receiver [m], world axes
    covariance: Array  # (E, STATES, STATES)


def estimate_drive(
    log: NavigationLog, mounts: Mounts, geo: GeoReference, ground: Callable[[Array, Array], Array], at_s: Array
) -> MotionEstimate:
    """Return the poses of a vehicle at the times `at_s` (T,) [s] within its log, smoothed over the whole log.

    geo: position of the map's origin. ground: heights [m] of the map at x, y (M,) [m]; NaN where it has several. The
    initial heading is unknown: `HEADINGS` are tried, and of those with which the car drives forwards the likeliest is
    taken; the deviations of those that are nearly as likely are in its covariance. Raises `InputError` where a time is
    not within the log, or the log's fixes and IMU contradict each other.
    """
    if (off := at_s[~log.covers(at_s)]).size:
        raise InputError(
            f"the navigation log goes from {log.begin_s:.1f} to {log.end_s:.1f} s, and a frame is at {off[0]:g} s"
        )
    mount = mounts.agent_from_imu
    inertia = (log.inertia.reshape(-1, 2, 3) @ mount[:3, :3].T).reshape(-1, 6)  # vehicle's axes
    levers = np.stack((mounts.agent_from_gnss[:3, 3], np.zeros(3))) - mount[:3, 3]
    places = convert_to_map(geo, log.fix)
    epochs, fixes = _list_epochs(log, places, ground, at_s)
    position, velocity, covariance = _begin(log, places, levers[0])
    begin = (position, velocity, rotations_about_z(2 * np.pi / HEADINGS * np.arange(HEADINGS)), covariance)
    measured = (epochs, fixes, _find_rest(log, inertia, epochs))
    states, transition, misfit, fit = _filter(log.imu_time_s, inertia, measured, levers, _sigmas(log), begin)
    tried = [tuple(values[i] for values in states) for i in range(HEADINGS)]
    forwards = [_measure_way(log.imu_time_s[epochs], both) > -BACKWARDS_M for both in tried]
    likelihood = np.nan_to_num(np.where(forwards, fit, -np.inf), nan=-np.inf)
    best = int(likelihood.argmax())
    if not np.nanmean(misfit[best]) < IMPOSSIBLE or not np.isfinite(tried[best][-1]).all():
        raise InputError("the fixes of the navigation log are not where its IMU leads: they are of no common drive")
    weights = softmax(likelihood)
    kept = np.flatnonzero(weights > LEAST_WEIGHT)
    state = _mix([(weights[i], _smooth(tried[i], transition[i])) for i in kept])
    rows = _nearest(log.imu_time_s, at_s)
    state = _States(*(values[np.searchsorted(epochs, rows)] for values in state))
    return _of_agent(state, inertia[rows, 3:], at_s - log.imu_time_s[rows], levers[1])


def _measure_way(times_s: Array, both: tuple[Array, ...]) -> float:
    """Return the net distance [m] that a vehicle drives forwards, by its updated states, of index 0, at these times."""
    _, velocity, turn, *_ = both
    return float(np.einsum("ei,ei->e", velocity[0], turn[0, :, :, 0]) @ np.gradient(times_s))


def _list_epochs(
    log: NavigationLog, places: Array, ground: Callable[[Array, Array], Array], at_s: Array
) -> tuple[Ints, Array]:
    """Return the IMU samples (E,) nearest to fixes and to `at_s`, and the fixes (E, 5), NaN where there are none.

    A fix is x, y, z [m], its time after the sample [s], and the height of the ground there [m]. places: (M, 3) of all
    fixes [m].
    """
    used = np.flatnonzero(log.covers(log.fix_time_s))
    near = _nearest(log.imu_time_s, log.fix_time_s[used])
    epochs = np.unique(np.concatenate((near, _nearest(log.imu_time_s, at_s))))
    fixes = np.full((len(epochs), 5), np.nan)
    row = np.searchsorted(epochs, near)
    x, y, _ = places[used].T
    fixes[row] = np.column_stack((places[used], log.fix_time_s[used] - log.imu_time_s[near], ground(x, y)))
    return epochs, fixes


def _nearest(times_s: Array, at_s: Array) -> Ints:
    """Return the index of the sample nearest to each of `at_s`."""
    after = np.clip(np.searchsorted(times_s, at_s), 1, len(times_s) - 1)
    return after - (at_s - times_s[after - 1] < times_s[after] - at_s)


def _sigmas(log: NavigationLog) -> Array:
    """Return the noise of the sensors' data sheets, (9,), at least `LEAST_SAMPLE` and `LEAST_FIX_M`.

    In order: standard deviations of a sample of force and rate, random walks of their biases, white noise of a fix
    horizontally and vertically, the receiver's bias horizontally and vertically, and its correlation time [s].
    """
    unit, receiver = log.unit, log.receiver
    samples = np.sqrt(unit.rate_hz / 2) * np.array((unit.force_noise, unit.rate_noise))
    walks = (unit.force_walk, unit.rate_walk)
    white = np.array((receiver.noise_m, receiver.noise_up_m))
    bias = (receiver.bias_m, receiver.bias_up_m, receiver.bias_s)
    return np.concatenate((np.maximum(samples, LEAST_SAMPLE), walks, np.maximum(white, LEAST_FIX_M), bias))


def _begin(log: NavigationLog, places: Array, lever: Array) -> tuple[Array, Array, Array]:
    """Return initial position, velocity and covariance at the first fix, of a level vehicle; world frame.

    places: (M, 3) of all fixes [m]. lever: (3,) from the IMU to the antenna [m]. The velocity is the mean over the
    first second. Raises `InputError` where there are fewer than two fixes while the IMU measures.
    """
    receiver, unit, times_s = log.receiver, log.unit, log.fix_time_s
    used = np.flatnonzero(log.covers(times_s))
    if len(used) < 2:
        raise InputError("the navigation log has no two fixes while its IMU measures")
    first, soon = used[0], used[max(1, int((times_s[used] <= times_s[used[0]] + 1.0).sum()) - 1)]
    velocity = (places[soon] - places[first]) / (times_s[soon] - times_s[first])
    white = np.array((receiver.noise_m, receiver.noise_m, receiver.noise_up_m))
    bias = np.array((receiver.bias_m, receiver.bias_m, receiver.bias_up_m))
    deviations = (
        BEGIN_M + 10 * (white + bias),
        np.full(3, BEGIN_MPS),
        (BEGIN_TILT_RAD, BEGIN_TILT_RAD, np.pi / HEADINGS),
        np.full(3, max(unit.force_bias, LEAST_BIAS)),
        np.full(3, max(unit.rate_bias, LEAST_BIAS)),
        np.maximum(bias, LEAST_BIAS),
    )
    return places[first] - (0, 0, lever[2]), velocity, np.diag(np.concatenate(deviations) ** 2)


def _find_rest(log: NavigationLog, inertia: Array, epochs: Ints) -> Mask:
    """Return (E,) whether the IMU's variation around an epoch is within its white noise."""
    half_width = max(round(QUIET_S * log.unit.rate_hz), 2)
    around = np.clip(epochs[:, None] + np.arange(-half_width, half_width + 1), 0, len(inertia) - 1)
    sigma = np.repeat((log.unit.force_noise, log.unit.rate_noise), 3) * np.sqrt(log.unit.rate_hz / 2)
    return (inertia[around].std(axis=1) <= QUIET * np.maximum(sigma, LEAST_BIAS)).all(axis=1)


def _skew(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross product with `v` (..., 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = np.moveaxis(v, -1, 0)
    return matrix - np.swapaxes(matrix, -1, -2)


def _exp(v: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3): Rodrigues' formula."""
    angle, cross = np.sqrt((v * v).sum(axis=-1))[..., None, None], _skew(v)
    turned = angle >= 1e-8
    angle = np.where(turned, angle, 1.0)
    sine, cosine = np.where(turned, np.sin(angle), 1.0), np.where(turned, np.cos(angle), 1.0)
    return np.eye(3) + sine / angle * cross + (1 - cosine) / angle**2 * (cross @ cross)


@np.errstate(all="ignore")  # states of a wrong heading may diverge: they have no likelihood then
def _filter(
    times_s: Array, inertia: Array, measured: tuple[Ints, Array, Mask], levers: Array, sigmas: Array, begin: Nominal
) -> tuple[tuple[Array, ...], Array, Array, Array]:
    """Return the updated and the predicted states (H, 2, E, ...), transitions between epochs, and measures of fit.

    measured: epochs (E,), fixes (E, 5), see `_list_epochs`, and whether at rest (E,). levers: (2, 3) from the IMU to
    antenna and vehicle's origin, vehicle's axes [m]. sigmas: see `_sigmas`. begin: position, velocity, turns (H, 3, 3),
    covariance; the filter runs from each turn. Measures of fit: normalised squared innovations (H, E) of fixes, and
    log-likelihood (H,) of all but zero-velocity updates, since which epochs have these depends on the nominal state.
    """
    epochs, fixes, rest = measured
    tried, count = len(begin[2]), len(epochs)
    position, velocity, p = (np.repeat(begin[i][None], tried, axis=0) for i in (0, 1, 3))
    state, likelihood = (position, velocity, begin[2], np.zeros((tried, 9))), np.zeros(tried)
    kept = tuple(np.zeros((tried, 2, count, *shape)) for shape in ((3,), (3,), (3, 3), (9,), (STATES, STATES)))
    transition = np.zeros((tried, count, STATES, STATES))
    misfit = np.tile(np.where(np.isfinite(fixes[:, 0]), 0.0, np.nan), (tried, 1))
    for e in range(count):
        rows = slice(epochs[max(e - 1, 0)], epochs[e] + 1)
        state, p, transition[:, e] = _predict(state, p, inertia[rows], np.diff(times_s[rows]), sigmas)
        for values, value in zip(kept, (*state, p)):
            values[:, 1, e] = value
        h, r, noise, common = _measure(state, inertia[epochs[e], 3:], fixes[e], rest[e], levers, sigmas)
        shift = np.zeros((tried, STATES))
        for i in range(len(noise)):  # sequential updates by scalars, since the measurements' noise is independent
            seen = (p @ h[:, i, :, None])[..., 0]
            variance = (seen * h[:, i]).sum(axis=1) + noise[i]
            missed = r[:, i] - (h[:, i] * shift).sum(axis=1)
            shift += seen * (missed / variance)[:, None]
            p -= seen[:, :, None] * (seen / variance[:, None])[:, None]
            if i < common:
                likelihood -= (missed**2 / variance + np.log(variance)) / 2
            if i < 3 and np.isfinite(fixes[e, 0]):
                misfit[:, e] += missed**2 / variance
        p = (p + np.swapaxes(p, 1, 2)) / 2  # symmetric despite rounding
        position, velocity, turn, bias = state
        state = (position + shift[:, :3], velocity + shift[:, 3:6], turn @ _exp(shift[:, 6:9]), bias + shift[:, 9:])
        for values, value in zip(kept, (*state, p)):
            values[:, 0, e] = value
    return kept, transition, misfit, likelihood


def _predict(state: Nominal, p: Array, inertia: Array, dt: Array, sigmas: Array) -> tuple[Nominal, Array, Array]:
    """Return the nominal states after K sample intervals `dt` [s], their errors' covariances, and the transitions.

    inertia: (K + 1, 6) samples at the ends of the intervals.
    """
    position, velocity, turn, bias = state
    sample, dt = (inertia[:-1] + inertia[1:]) / 2, dt[:, None]
    force, rate = sample[:, :3] - bias[:, None, :3], sample[:, 3:] - bias[:, None, 3:6]
    turns = [turn]
    for change in np.moveaxis(_exp(rate * dt), 1, 0):
        turns.append(turns[-1] @ change)
    middle = np.stack(turns, axis=1)[:, :-1] @ _exp(rate * dt / 2)
    acceleration = (middle @ force[..., None])[..., 0] + GRAVITY
    velocities = np.cumsum(np.concatenate((velocity[:, None], acceleration * dt), axis=1), axis=1)
    position = position + (velocities[:, :-1] * dt + acceleration * dt**2 / 2).sum(axis=1)
    steps, spread = _transit(middle, force, rate, dt, sigmas)
    phi = np.eye(STATES)
    for k in range(len(dt)):
        step = steps[:, k]
        p = step @ p @ np.swapaxes(step, 1, 2) + np.diag(spread[k])
        phi = step @ phi
    bias = np.concatenate((bias[:, :6], bias[:, 6:] * np.exp(-dt / sigmas[8]).prod()), axis=1)
    return (position, velocities[:, -1], turns[-1], bias), p, phi


def _transit(middle: Array, force: Array, rate: Array, dt: Array, sigmas: Array) -> tuple[Array, Array]:
    """Return transitions (H, K, STATES, STATES) of the error state over sample intervals, and their noise (K, STATES).

    middle: attitudes (H, K, 3, 3) in the middle of the intervals `dt` (K, 1) [s]. force, rate: (H, K, 3), without bias.
    """
    step, wide = np.tile(np.eye(STATES), (*rate.shape[:2], 1, 1)), dt[:, None]
    spread = np.zeros((len(dt), STATES))
    step[..., :3, 3:6], step[..., 6:9, 12:15] = np.eye(3) * wide, -np.eye(3) * wide
    step[..., 3:6, 6:9], step[..., 3:6, 9:12] = -(middle @ _skew(force)) * wide, -middle * wide
    step[..., 6:9, 6:9], step[..., 15:, 15:] = _exp(-rate * dt), np.eye(3) * np.exp(-wide / sigmas[8])
    spread[:, 3:6], spread[:, 6:9] = (sigmas[0] * dt) ** 2, (sigmas[1] * dt) ** 2
    spread[:, 9:12], spread[:, 12:15] = sigmas[2] ** 2 * dt, sigmas[3] ** 2 * dt
    spread[:, 15:] = sigmas[[6, 6, 7]] ** 2 * (1 - np.exp(-2 * dt / sigmas[8]))
    return step, spread


def _measure(
    state: Nominal, sample: Array, fix: Array, rests: bool, levers: Array, sigmas: Array
) -> tuple[Array, Array, Array, int]:
    """Return Jacobians (H, M, STATES), innovations (H, M) and variances (M,) of an epoch's measurements, and a count.

    In order: the fix and the height of the ground, where there are any; lateral and vertical velocity; velocity and
    angular rate, at rest. The count is that of the measurements before the last group. sample: (3,) angular rate
    [rad/s].
    """
    position, velocity, turn, bias = state
    h, r, noise, rows = np.zeros((len(turn), 12, STATES)), np.zeros((len(turn), 12)), np.zeros(12), 0
    rate = sample - bias[:, 3:6]
    back = (velocity[:, None] @ turn)[:, 0]
    if np.isfinite(fix[0]):
        h[:, :3, :3], h[:, :3, 3:6], h[:, :3, 15:] = np.eye(3), np.eye(3) * fix[3], np.eye(3)
        h[:, :3, 6:9] = -turn @ _skew(levers[0])
        r[:, :3] = fix[:3] - (position + velocity * fix[3] + turn @ levers[0] + bias[:, 6:])
        noise[:2], noise[2], rows = sigmas[4] ** 2, sigmas[5] ** 2, 3
    if np.isfinite(fix[4]):
        h[:, rows, 2] = 1
        h[:, rows, 6:9] = -(turn @ _skew(levers[1]))[:, 2]
        r[:, rows], noise[rows] = fix[4] - position[:, 2] - (turn @ levers[1])[:, 2], HEIGHT_M**2
        rows += 1
    along = back + _skew(rate) @ levers[1]  # velocity of the vehicle's origin, vehicle's axes
    for axis in range(1, 3):
        h[:, rows, 3:6] = turn[:, :, axis]
        h[:, rows, 6:9] = _skew(back)[:, axis]
        h[:, rows, 12:15] = _skew(levers[1])[axis]
        r[:, rows], noise[rows] = -along[:, axis], (ACROSS_MPS if axis == 1 else UP_MPS) ** 2
        rows += 1
    common = rows
    if rests:  # a row of zeros changes nothing: for headings with which the vehicle is too fast to be at rest
        slow = (np.sqrt((velocity * velocity).sum(axis=1)) < SLOW_MPS)[:, None]
        still = slow[..., None] * np.eye(3)
        h[:, rows : rows + 3, 3:6], h[:, rows + 3 : rows + 6, 12:15] = still, still
        r[:, rows : rows + 3], r[:, rows + 3 : rows + 6] = np.where(slow, -velocity, 0), np.where(slow, rate, 0)
        noise[rows : rows + 3], noise[rows + 3 : rows + 6] = REST_MPS**2, REST_RADPS**2 + sigmas[1] ** 2
        rows += 6
    return h[:, :rows], r[:, :rows], noise[:rows], common


def _smooth(both: tuple[Array, ...], transition: Array) -> _States:
    """Return the smoothed states: each updated state, corrected by the smoothed next one (Rauch-Tung-Striebel).

    both: the updated and the predicted states (2, E, ...).
    """
    updated, predicted = (_States(*(values[i] for values in both)) for i in range(2))
    smoothed = _States(*(values.copy() for values in updated))
    for k in range(len(transition) - 2, -1, -1):
        predicted_covariance = predicted.covariance[k + 1]
        gain = np.linalg.solve(predicted_covariance, transition[k + 1] @ updated.covariance[k]).T
        missed = np.concatenate(
            (
                smoothed.position[k + 1] - predicted.position[k + 1],
                smoothed.velocity[k + 1] - predicted.velocity[k + 1],
                _log(predicted.turn[k + 1].T @ smoothed.turn[k + 1]),
                smoothed.bias[k + 1] - predicted.bias[k + 1],
            )
        )
        shift = gain @ missed
        smoothed.position[k] += shift[:3]
        smoothed.velocity[k] += shift[3:6]
        smoothed.turn[k] = updated.turn[k] @ _exp(shift[6:9])
        smoothed.bias[k] += shift[9:]
        smoothed.covariance[k] += gain @ (smoothed.covariance[k + 1] - predicted_covariance) @ gain.T
    return smoothed


def _mix(states: list[tuple[float, _States]]) -> _States:
    """Return the likeliest of several states, with the others' deviations in position and heading in its covariance."""
    likeliest = max(states, key=lambda weighted: weighted[0])[1]
    covariance = likeliest.covariance.copy()
    for weight, other in states:
        deviation = other.position - likeliest.position
        across = np.einsum("eij,eij->e", likeliest.turn[:, :2, 1:2], other.turn[:, :2, :1])
        along = np.einsum("eij,eij->e", likeliest.turn[:, :2, :1], other.turn[:, :2, :1])
        heading = np.arctan2(across, along)[:, None] * likeliest.turn[:, 2]  # about the vertical, vehicle's axes
        covariance[:, :3, :3] += weight * deviation[:, :, None] * deviation[:, None]
        covariance[:, 6:9, 6:9] += weight * heading[:, :, None] * heading[:, None]
    return likeliest._replace(covariance=covariance)


def _log(turn: Array) -> Array:
    """Return the rotation vector (3,) of a rotation matrix (3, 3) by less than half a turn."""
    cross = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
    sine = np.linalg.norm(cross)
    angle = np.arctan2(sine, (np.trace(turn) - 1) / 2)
    return cross * (angle / sine if sine > 1e-9 else 1.0)


def _of_agent(state: _States, rate: Array, after_s: Array, lever: Array) -> MotionEstimate:
    """Return the poses of the vehicle's origin, `lever` (3,) [m] from the IMU, `after_s` (T,) [s] after the states."""
    count = len(after_s)
    poses, covariance = np.zeros((count, 4, 4)), np.zeros((count, 6, 6))
    for i in range(count):
        turn = state.turn[i] @ _exp((rate[i] - state.bias[i, 3:6]) * after_s[i])
        poses[i, :3, :3], poses[i, 3, 3] = turn, 1.0
        poses[i, :3, 3] = state.position[i] + state.velocity[i] * after_s[i] + turn @ lever
        jacobian = np.zeros((6, STATES))
        jacobian[:3, :3], jacobian[:3, 6:9], jacobian[3:, 6:9] = np.eye(3), -turn @ _skew(lever), np.eye(3)
        covariance[i] = jacobian @ state.covariance[i] @ jacobian.T
    return MotionEstimate(poses, covariance)
