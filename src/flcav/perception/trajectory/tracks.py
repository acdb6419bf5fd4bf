"""Tracks of a traffic trace, interpolated at the task's instants and transformed into the frame of a pose.

Interpolation is by cubic Hermite curves with Catmull-Rom tangents. What a network may know of the present is
extrapolated, since a trace's states are smoothed over later ones.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array
from flcav.config import InputError
from flcav.geometry import heading_vectors, wrap_angle
from flcav.perception.trajectory.config import FUTURE, PAST, STEP_S
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import REACH_S

GAP_S = 0.5  # largest time between two instants of a trace
OFFSETS_S: Array = np.arange(-PAST, FUTURE + 1, dtype=np.float64) * STEP_S  # of a track's points from the present


class Tracks(NamedTuple):
    """Tracks of all A actors of a trace at S instants; NaN where an actor is absent."""

    position: Array  # (S, A, 2) world [m]
    yaw: Array  # (S, A) [rad]
    speed: Array  # (S, A) [m/s]


def check_instants(trace: Trace, origin: str) -> None:
    """Raise `InputError` if the instants of `trace` are more than `GAP_S` apart, or fewer than two."""
    gaps = np.diff(trace.time_s)
    if len(gaps) == 0 or gaps.max() > GAP_S + 1e-6:
        said = f"spins up to {gaps.max():g} s apart" if len(gaps) else "a single spin"
        raise InputError(f"{origin}: {said}; the trajectory task wants them every {GAP_S:g} s or more often")


def tracks_around(trace: Trace, time_s: float) -> Tracks:
    """Return the tracks at `time_s + OFFSETS_S`; points up to `time_s` [s] depend on nothing that happens after it.

    A trace's states are averages that include states up to `REACH_S` later. Points up to `time_s` are therefore
    computed from the instants up to `REACH_S` before it: interpolated between these, and extrapolated from the last
    one. An actor is present at an extrapolated point if it is at the last instant up to that point. Points after
    `time_s` are the trace's.
    """
    times_s = np.round(time_s + OFFSETS_S, 6)
    known = int(np.searchsorted(trace.time_s, time_s - REACH_S + 1e-6, side="right"))
    last_s = trace.time_s[known - 1] if known else np.inf  # without one, all is NaN
    between = int(np.searchsorted(times_s[: PAST + 1], last_s + 1e-6, side="right"))
    parts = [
        tracks_at(trace, times_s[:between], known),
        _rebuilt(trace, times_s[between : PAST + 1], known - 1),
        tracks_at(trace, times_s[PAST + 1 :]),
    ]
    return Tracks(*(np.concatenate(points) for points in zip(*parts)))


def _rebuilt(trace: Trace, times_s: Array, instant: int) -> Tracks:
    """Return the tracks, extrapolated from an instant to `times_s` (S,) [s], of the actors that are then present."""
    there = trace.present[np.searchsorted(trace.time_s, times_s + 1e-6, side="right") - 1]
    position, yaw, speed = extrapolate(trace, instant, times_s - trace.time_s[instant])
    return Tracks(
        np.where(there[..., None], position, np.nan), np.where(there, yaw, np.nan), np.where(there, speed, np.nan)
    )


def extrapolate(trace: Trace, instant: int, ahead_s: Array) -> Tracks:
    """Return the tracks `ahead_s` (S,) [s] after an instant of the trace, from the states of that instant alone.

    Vehicles keep their turn rate, and their acceleration until they stand (CTRA, constant turn rate and acceleration:
    Schubert et al., "Comparison and evaluation of advanced motion models for vehicle tracking", FUSION 2008). The
    distance driven is laid on an arc, which is exact at constant speed and on straight lines. Pedestrians, whom SUMO
    moves without turning them, keep their velocity. NaN where an actor is absent at the instant.
    """
    velocity = trace.velocity[instant, :, :2]
    yaw = trace.yaw[instant]
    walking = trace.category == "pedestrian"
    speed = np.linalg.norm(velocity, axis=1)
    gain = np.where(walking, 0.0, (trace.acceleration[instant, :, :2] * heading_vectors(yaw)).sum(axis=1))
    turn = np.where(walking, 0.0, trace.yaw_rate[instant])
    ahead = ahead_s[:, None]
    driven_s = np.where(gain < 0, np.minimum(ahead, speed / np.maximum(-gain, 1e-9)), ahead)  # until it stands
    distance = speed * driven_s + gain * driven_s**2 / 2
    half = turn * ahead / 2
    chord = distance * np.sinc(half / np.pi)
    moved = np.where(walking[:, None], velocity * ahead[..., None], chord[..., None] * heading_vectors(yaw + half))
    return Tracks(
        trace.position[instant, :, :2] + moved, wrap_angle(yaw + 2 * half), np.maximum(speed + gain * ahead, 0)
    )


def tracks_at(trace: Trace, times_s: Array, known: int | None = None) -> Tracks:
    """Return the tracks at `times_s` (S,), interpolated from the first `known` instants of the trace (None: all).

    Positions are on cubic Hermite curves with Catmull-Rom tangents, yaw and speed are linear. An actor is present at a
    time if it is present at both instants around it.
    """
    knots = trace.time_s[:known]
    position = trace.position[:known, :, :2]
    if not len(knots):
        shape = (len(times_s), len(trace.actor))
        return Tracks(np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.full(shape, np.nan))
    times_s = np.round(times_s, 6)
    last = np.clip(np.searchsorted(knots, times_s, side="right") - 1, 0, len(knots) - 1)
    after = np.where(times_s <= knots[last] + 1e-6, last, np.minimum(last + 1, len(knots) - 1))
    gap = np.where(after > last, knots[after] - knots[last], 1.0)[:, None]
    share = np.where(after > last, (times_s - knots[last]) / gap[:, 0], 0.0)[:, None]
    within = (times_s >= knots[0] - 1e-6) & (times_s <= knots[-1] + 1e-6)
    there = trace.present[last] & trace.present[after] & within[:, None]
    tangent = _tangents(knots, position)
    u, h = share[..., None], gap[..., None]
    curve = (
        (1 + 2 * u) * (1 - u) ** 2 * position[last]
        + u * (1 - u) ** 2 * h * tangent[last]
        + u**2 * (3 - 2 * u) * position[after]
        + u**2 * (u - 1) * h * tangent[after]
    )
    speed = np.linalg.norm(trace.velocity[..., :2], axis=2)
    yaw = trace.yaw[last] + share * wrap_angle(trace.yaw[after] - trace.yaw[last])
    return Tracks(
        position=np.where(there[..., None], curve, np.nan),
        yaw=np.where(there, wrap_angle(yaw), np.nan),
        speed=np.where(there, speed[last] + share * (speed[after] - speed[last]), np.nan),
    )


def _tangents(knots: Array, position: Array) -> Array:
    """Return the tangents (T, A, 2) [m/s]: the mean of the slopes before and after, one-sided if one is missing."""
    slope = np.diff(position, axis=0) / np.diff(knots)[:, None, None]
    none = np.full_like(position[:1], np.nan)
    sides = np.stack((np.concatenate((none, slope)), np.concatenate((slope, none))))
    count = np.isfinite(sides).sum(axis=0)
    return np.where(np.isfinite(sides), sides, 0.0).sum(axis=0) / np.maximum(count, 1)


def into_frame(points: Array, pose: Array) -> Array:
    """Transform world points (N, ..., 2) into the frames of poses (N, 3) x, y, yaw: x ahead, y to the left [m]."""
    spread = (slice(None), *(None,) * (points.ndim - 2))
    cos, sin = (part[spread] for part in heading_vectors(pose[:, 2]).T)
    x, y = points[..., 0] - pose[:, 0][spread], points[..., 1] - pose[:, 1][spread]
    return np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)


def out_of_frame(points: Array, pose: Array) -> Array:
    """Transform points (N, ..., 2) from the frames of poses (N, 3) x, y, yaw to the world: `into_frame` inverted."""
    spread = (slice(None), *(None,) * (points.ndim - 2))
    cos, sin = (part[spread] for part in heading_vectors(pose[:, 2]).T)
    x, y = points[..., 0], points[..., 1]
    return np.stack((cos * x - sin * y + pose[:, 0][spread], sin * x + cos * y + pose[:, 1][spread]), axis=-1)


def constant_velocity(past: NDArray[np.floating]) -> Array:
    """Return the constant-velocity paths (N, FUTURE, 2) [m], at the present heading and speed.

    `past` (N, PAST + 1, 4) is the column of `Samples`; the paths are in the same frames.
    """
    ahead = past[:, -1, 3, None] * STEP_S * np.arange(1, FUTURE + 1)
    return np.stack((ahead, np.zeros_like(ahead)), axis=-1).astype(np.float64)
