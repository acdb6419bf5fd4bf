"""Checks of one frame: ranges of values, complete LiDAR sweeps, points in boxes, agreement with the traffic.

Each check yields one sentence per problem.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import inverse, is_rigid, points_in_boxes, transform_points, wrap_angle
from flcav.sensors.frame import Array, Frame
from flcav.sensors.lidar.air import rain_range_noise
from flcav.sensors.lidar.rolling import Motion
from flcav.world.scene import OFFSET_S
from flcav.world.trace import CATEGORIES, Trace

MARGIN_M = 0.15  # distance by which a return may lie outside its actor's box: range noise, wing mirrors
SIGMAS = 4.0  # additional margin in standard deviations of the range noise of rain
INSIDE = 0.95  # share of an actor's returns that must lie in its enlarged box
LONGEST_SPIN_S = 2 * OFFSET_S
GAP_DEG = 30.0  # widest azimuth sector without returns in a complete sweep
STEEP_DEG, SKY_DEG = 8.0, 180.0  # tilt of a vehicle from which on its LiDARs may see the sky alone, in such a sector
FORCE = 200.0  # limit of the specific force [m/s^2]
RATE = 20.0  # limit of the angular rate [rad/s]
FARTHEST = 1e9  # [m], [m/s]: beyond, squares of numbers say nothing
STRAY_M, STRAY_DEG, SPEED_M_S = (
    5.0,
    30.0,
    100.0,
)  # most that an agent's pose differs at a sensor's trigger, and per second
EXACT = 1e-6  # tolerance between values that are stored twice [s], [m], [rad], [m/s]


def check_values(frame: Frame, *, imported: bool = False) -> Iterator[str]:
    """Check that numbers are finite and in range, the pose is rigid, classes are known and tracks unique.

    In an imported dataset velocities and occlusions may be NaN, which is unknown, classes are any, and a spin may begin
    or end at the frame's time.
    """
    truth = frame.annotations
    for name, points in frame.lidar.items():
        if not np.isfinite(points).all():
            yield f"{frame.key}: '{name}' has a point that is not finite"
        elif ((points[:, 3] < 0) | (points[:, 3] > 1)).any():
            yield f"{frame.key}: '{name}' has an intensity outside 0 to 1"
    for name, times_s in frame.point_times.items():
        if not (np.abs(times_s) <= (LONGEST_SPIN_S if imported else LONGEST_SPIN_S / 2)).all():
            yield f"{frame.key}: '{name}' has a point that was measured in no spin around the frame's time"
    if not is_rigid(frame.world_from_agent):
        yield f"{frame.key}: the pose of {frame.agent} is not a rigid transform"
    for category in () if imported else sorted(set(truth.boxes.label.tolist()) - set(CATEGORIES)):
        yield f"{frame.key}: unknown class '{category}'; known: {', '.join(CATEGORIES)}"
    tracks, times = np.unique(truth.track, return_counts=True)
    for track in tracks[times > 1]:
        yield f"{frame.key}: '{track}' is annotated more than once"
    if frame.agent in tracks:
        yield f"{frame.key}: {frame.agent} is annotated in its own frame"
    unsure = np.column_stack((truth.velocity, truth.occlusion))
    numbers = np.column_stack((truth.boxes.array(), np.where(np.isnan(unsure), 0.0, unsure) if imported else unsure))
    for track in truth.track[~np.isfinite(numbers).all(axis=1)]:
        yield f"{frame.key}: the annotation of '{track}' has a number that is not finite"
    with np.errstate(invalid="ignore"):
        far = (np.abs(numbers) > FARTHEST).any(axis=1)
    for track in truth.track[far & np.isfinite(numbers).all(axis=1)]:
        yield f"{frame.key}: the annotation of '{track}' has a number beyond {FARTHEST:g}"
    for track in truth.track[(truth.boxes.size <= 0).any(axis=1)]:
        yield f"{frame.key}: the box of '{track}' has no volume"
    for track in truth.track[(truth.returns < 0) | (truth.occlusion < 0) | (truth.occlusion > 1)]:
        yield f"{frame.key}: the annotation of '{track}' has negative returns, or an occlusion outside 0 to 1"


def check_triggers(frame: Frame) -> Iterator[str]:
    """Check that the agent's pose when a sensor triggers is near that at the spin, and rigid."""
    for name, then in frame.agent_at_trigger.items():
        if not (is_rigid(then) and is_rigid(frame.world_from_agent)):
            yield f"{frame.key}: the pose of {frame.agent} when '{name}' triggers is not a rigid transform"
            continue
        between = inverse(frame.world_from_agent) @ then
        metres = float(np.linalg.norm(between[:3, 3]))
        degrees = float(np.degrees(np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))))
        seconds = abs(frame.calibration.offset_ms.get(name, 0.0)) / 1000
        if metres > STRAY_M + SPEED_M_S * seconds or degrees > STRAY_DEG:
            yield (
                f"{frame.key}: the pose of {frame.agent} when '{name}' triggers is {metres:.1f} m and {degrees:.0f} "
                "degrees from that at the spin"
            )


def check_sweeps(frame: Frame) -> Iterator[str]:
    """Check that each LiDAR's sweep covers all azimuths; LiDARs with a point that is not finite are skipped.

    On steep ground a LiDAR looks over the land on one side: there half of the azimuths may be without returns.
    """
    steep = frame.world_from_agent[2, 2] < math.cos(math.radians(STEEP_DEG))
    for name, points in frame.lidar.items():
        if not np.isfinite(points).all():
            continue
        azimuth = np.sort(np.degrees(np.arctan2(points[:, 1], points[:, 0])))
        gap = np.diff(azimuth, append=azimuth[:1] + 360.0).max(initial=0.0) if len(points) else 360.0
        if gap > (SKY_DEG if steep else GAP_DEG):
            yield f"{frame.key}: '{name}' is no whole spin, nothing comes back from a sector of {gap:.0f} degrees"


def check_measurements(frame: Frame) -> Iterator[str]:
    """Check that measurements of radars, GNSS receivers and inertial measurement units are physically possible."""
    for name, detections in frame.radar.items():
        if not np.isfinite(detections).all() or (detections[:, 0] <= 0).any():
            yield f"{frame.key}: '{name}' has a detection that is not finite, or at no range"
        if (np.abs(detections[:, 1]) > np.pi).any() or (np.abs(detections[:, 2]) > np.pi / 2).any():
            yield f"{frame.key}: '{name}' has a detection at an impossible angle"
    for name, (latitude, longitude, altitude) in frame.gnss.items():
        if not (abs(latitude) <= 90 and abs(longitude) <= 180 and np.isfinite(altitude)):
            yield f"{frame.key}: '{name}' is nowhere on Earth"
    for name, values in frame.imu.items():
        if not (np.abs(values[:3]).max() < FORCE and np.abs(values[3:]).max() < RATE):
            yield f"{frame.key}: '{name}' reports a motion that nothing survives"


def check_points(frame: Frame, trace: Trace | None = None, *, imported: bool = False) -> Iterator[str]:
    """Check that each actor's enlarged box contains as many points as the annotation counts returns.

    Points of a rolling LiDAR are compensated for the motion of the carrier and the actor by `trace`; those of an
    imported dataset are as they are. The check is skipped without `trace` for a rolling LiDAR of a recording, and where
    a point or a box is not finite or beyond `FARTHEST`.
    """
    if not frame.lidar or (frame.point_times and trace is None and not imported):
        return
    if not all(np.isfinite(points).all() for points in frame.lidar.values()):
        return
    motions = _motions(frame, trace) if trace is not None and frame.point_times else {}
    everything, times_s = _in_world(frame, motions.get(frame.agent))
    boxes, returns = frame.annotations.boxes, frame.annotations.returns
    if not (np.abs(boxes.array()) <= FARTHEST).all():
        return
    away = np.linalg.norm(boxes.center - frame.world_from_agent[:3, 3], axis=1)
    rain = rain_range_noise(frame.weather.rain_mm_h) if frame.weather else 0.0
    for i in np.flatnonzero(returns > 0):
        track, label = str(frame.annotations.track[i]), boxes.label[i]
        points = motions[track].bring_back(everything, times_s) if track in motions else everything
        count = int(points_in_boxes(points, boxes[[i]], MARGIN_M + SIGMAS * rain * away[i]).sum())
        if count < INSIDE * returns[i]:
            yield f"{frame.key}: points lie outside the box of {label} '{track}': {count} of {returns[i]} within"


def _in_world(frame: Frame, carrier: Motion | None) -> tuple[Array, NDArray[np.float32]]:
    """Return (N, 3) points of all LiDARs in the world frame [m], and (N,) their times [s] after the spin.

    `carrier` is the motion of the agent during the spin; None leaves it at its pose at the spin.
    """
    clouds, times = [], []
    for name, points in frame.lidar.items():
        cloud = transform_points(frame.world_from_sensor(name), points[:, :3].astype(np.float64))
        times.append(frame.point_times.get(name, np.zeros(len(points), np.float32)))
        clouds.append(cloud if carrier is None else carrier.carry(cloud, times[-1]))
    return np.concatenate(clouds), np.concatenate(times)


def _motions(frame: Frame, trace: Trace) -> dict[str, Motion]:
    """Return actor -> its motion at the time of the spin; empty where `trace` has no such instant."""
    motions = {}
    for instant in np.flatnonzero(np.abs(trace.time_s - frame.time_s) < EXACT)[:1].tolist():
        for actor in np.flatnonzero(trace.present[instant]).tolist():
            motions[str(trace.actor[actor])] = Motion.of(trace, instant, actor)
    return motions


def check_traffic(frame: Frame, trace: Trace) -> Iterator[str]:
    """Check that the pose of the agent and all annotations agree with the traffic `trace` at the frame's time."""
    instant = np.flatnonzero(np.abs(trace.time_s - frame.time_s) < EXACT)
    if not len(instant):
        yield f"{frame.key}: the traffic of '{frame.scene}' has no instant at {frame.time_s} s"
        return
    t, truth = int(instant[0]), frame.annotations
    centres = trace.box_centres(t)
    actor = {name: i for i, name in enumerate(trace.actor.tolist()) if trace.present[t, i]}
    if frame.agent in actor:
        away = np.linalg.norm(frame.world_from_agent[:3, 3] - trace.position[t, actor[frame.agent]])
        if not away < EXACT:
            yield f"{frame.key}: {frame.agent} is {away:.2f} m from where the traffic has it"
    for i, track in enumerate(truth.track.tolist()):
        if track not in actor:
            yield f"{frame.key}: '{track}' is annotated but not in town"
            continue
        a = actor[track]
        away = math.dist(truth.boxes.center[i], centres[a])  # never overflows
        turned = np.abs(wrap_angle(truth.boxes.yaw[i] - trace.yaw[t, a]))
        grown = np.abs(truth.boxes.size[i] - trace.size[a]).max()
        faster = np.abs(truth.velocity[i] - trace.velocity[t, a]).max()
        if not max(away, turned, grown, faster) < EXACT:
            yield (
                f"{frame.key}: the box of '{track}' is not what the traffic has: {away:.2f} m away, "
                f"{np.degrees(turned):.1f} degrees turned, size {grown:.2f} m and speed {faster:.2f} m/s different"
            )
        if truth.boxes.label[i] != trace.category[a]:
            yield f"{frame.key}: '{track}' is annotated as {truth.boxes.label[i]}, it is a {trace.category[a]}"
