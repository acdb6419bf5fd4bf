"""Checks of a frame and of its agent's calibration; each check yields one sentence per problem.

They cover ranges of values, complete LiDAR sweeps, points in boxes, agreement with the traffic, images with their 2D
annotations, and sensor mounts.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flcav.config import parse_config
from flcav.dataset.calibration import Calibrations
from flcav.geometry import Boxes, inverse, is_rigid, points_in_boxes, transform_points, wrap_angle
from flcav.sensors.frame import Array, Calibration, CameraImage, Frame, SignViews, Views
from flcav.sensors.ground_truth import STATES
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.lidar.air import rain_range_noise
from flcav.sensors.lidar.rolling import Motion
from flcav.sensors.rig import CalibrationError
from flcav.sensors.views import find_actor_regions
from flcav.world.scene import OFFSET_S
from flcav.world.trace import CATEGORIES, Trace

MARGIN_M = 0.15  # distance by which a return may lie outside its actor's box: range noise, wing mirrors
RAIN_SIGMAS = 4.0  # additional margin in standard deviations of the range noise of rain
POINTS_INSIDE = 0.95  # share of an actor's returns that must lie in its enlarged box
LONGEST_SPIN_S = 2 * OFFSET_S
GAP_DEG = 30.0  # widest azimuth sector without returns in a complete sweep
STEEP_DEG, SKY_DEG = 8.0, 180.0  # tilt of a vehicle from which on its LiDARs may see the sky alone, in such a sector
FORCE = 200.0  # limit of the specific force [m/s^2]
RATE = 20.0  # limit of the angular rate [rad/s]
FARTHEST = 1e9  # [m], [m/s]: beyond it, squares of numbers lose all precision
STRAY_M, STRAY_DEG, SPEED_M_S = (
    5.0,
    30.0,
    100.0,
)  # most that an agent's pose differs at a sensor's trigger, and per second
SAME = 1e-6  # tolerance between values that are stored twice [s], [m], [rad], [m/s]


def check_values(frame: Frame, *, imported: bool = False) -> Iterator[str]:
    """Check that numbers are finite and in range, the pose is rigid, classes are known and tracks unique.

    In an imported dataset unknown velocities and occlusions may be NaN, classes are arbitrary, and a spin may begin or
    end at the frame's time.
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
    """Check that the agent's pose when a sensor triggers is rigid, and near the pose at the spin."""
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
    """Check that the sweep of each LiDAR covers all azimuths; LiDARs with a point that is not finite are skipped.

    On steep ground a LiDAR looks over the land on one side, where half of the azimuths may have no returns.
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

    Points of a rolling LiDAR are compensated for the motion of the carrier and of the actor by `trace`; those of an
    imported dataset are taken as they are. The check is skipped for a rolling LiDAR of a recording without `trace`, and
    where a point or a box is not finite or beyond `FARTHEST`.
    """
    if not frame.lidar or (frame.point_times and trace is None and not imported):
        return
    if not all(np.isfinite(points).all() for points in frame.lidar.values()):
        return
    motions = _motions(frame, trace) if trace is not None and frame.point_times else {}
    everything, times_s = _in_world(frame, motions.get(frame.agent))
    boxes = frame.annotations.boxes
    returns = frame.annotations.returns
    if not (np.abs(boxes.array()) <= FARTHEST).all():
        return
    away = np.linalg.norm(boxes.center - frame.world_from_agent[:3, 3], axis=1)
    rain = rain_range_noise(frame.weather.rain_mm_h) if frame.weather else 0.0
    for i in np.flatnonzero(returns > 0):
        track = str(frame.annotations.track[i])
        label = boxes.label[i]
        points = motions[track].bring_back(everything, times_s) if track in motions else everything
        # In a rolling sweep the actor moves between its first and last return: bring them back to the time of the spin.
        count = int(points_in_boxes(points, boxes[[i]], MARGIN_M + RAIN_SIGMAS * rain * away[i]).sum())
        if count < POINTS_INSIDE * returns[i]:
            yield f"{frame.key}: points lie outside the box of {label} '{track}': {count} of {returns[i]} within"


def _in_world(frame: Frame, carrier: Motion | None) -> tuple[Array, NDArray[np.float32]]:
    """Return the points (N, 3) of all LiDARs in the world frame [m], and their times (N,) after the spin [s].

    `carrier` is the motion of the agent during the spin; for None the agent stays at its pose at the spin.
    """
    clouds, times = [], []
    for name, points in frame.lidar.items():
        cloud = transform_points(frame.world_from_sensor(name), points[:, :3].astype(np.float64))
        times.append(frame.point_times.get(name, np.zeros(len(points), np.float32)))
        clouds.append(cloud if carrier is None else carrier.carry(cloud, times[-1]))
    return np.concatenate(clouds), np.concatenate(times)


def _motions(frame: Frame, trace: Trace) -> dict[str, Motion]:
    """Return the motions of the actors at the time of the spin, by name; empty where `trace` has no such instant."""
    motions = {}
    for instant in np.flatnonzero(np.abs(trace.time_s - frame.time_s) < SAME)[:1].tolist():
        for actor in np.flatnonzero(trace.present[instant]).tolist():
            motions[str(trace.actor[actor])] = Motion.of(trace, instant, actor)
    return motions


def check_traffic(frame: Frame, trace: Trace) -> Iterator[str]:
    """Check that the agent's pose and all annotations agree with the traffic `trace` at the frame's time."""
    instant = np.flatnonzero(np.abs(trace.time_s - frame.time_s) < SAME)
    if not len(instant):
        yield f"{frame.key}: the traffic of '{frame.scene}' has no instant at {frame.time_s} s"
        return
    t = int(instant[0])
    truth = frame.annotations
    centres = trace.box_centres(t)
    actor = {name: i for i, name in enumerate(trace.actor.tolist()) if trace.present[t, i]}
    if frame.agent in actor:
        away = np.linalg.norm(frame.world_from_agent[:3, 3] - trace.position[t, actor[frame.agent]])
        if not away < SAME:
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
        if not max(away, turned, grown, faster) < SAME:
            yield (
                f"{frame.key}: the box of '{track}' is not what the traffic has: {away:.2f} m away, "
                f"{np.degrees(turned):.1f} degrees turned, size {grown:.2f} m and speed {faster:.2f} m/s different"
            )
        if truth.boxes.label[i] != trace.category[a]:
            yield f"{frame.key}: '{track}' is annotated as {truth.boxes.label[i]}, it is a {trace.category[a]}"


PIXEL_MARGIN_M = (
    0.3  # distance by which a pixel may lie outside its actor's 3D box: wing mirrors, turning since the spin
)
MARGIN_PX = 3.0  # distance by which a pixel may lie outside its actor's amodal box
PIXELS_INSIDE = 0.95  # share of an actor's sampled pixels that must lie in its enlarged box
JUDGED = 40  # pixels sampled of each actor; actors with fewer are skipped
SIGN_STATES = {"", "off", *STATES.values()}


def check_images(frame: Frame, *, imported: bool = False) -> Iterator[str]:
    """Check every image of a frame and its annotations of actors, signs and lights.

    Images of an imported dataset have no depths, classes and instances to check against.
    """
    for name in (*frame.images, *frame.infrared):
        yield from check_views(frame.key, name, frame.annotations.views[name], imported=imported)
        yield from check_signs(frame.key, name, frame.annotations.signs[name])
    for name, image in () if imported else frame.images.items():
        yield from check_planes(frame.key, name, image, len(frame.annotations))
        if not _fit(image):
            continue
        lens = _lens(frame, name, image)
        yield from check_visibility(frame, name, image)
        yield from check_projection(frame, name, image, lens)
        yield from check_placed_signs(frame.key, name, frame.annotations.signs[name], lens)


def check_views(key: str, name: str, views: Views, *, imported: bool = False) -> Iterator[str]:
    """Check that truncation and occlusion are in [0, 1] and that boxes have an area.

    `key` names the frame and `name` the camera, here and below. In an imported dataset an unknown occlusion may be NaN.
    """
    occlusion = np.where(np.isnan(views.occlusion), 0.0, views.occlusion) if imported else views.occlusion
    shares = np.column_stack((views.truncation, occlusion))
    if not ((shares >= 0) & (shares <= 1)).all():
        yield f"{key}: '{name}' has a truncation or an occlusion outside 0 to 1"
    for kind, box in (("amodal", views.amodal_box), ("visible", views.visible_box)):
        known = box[~np.isnan(box).any(axis=1)]
        if (known[:, 2:] <= known[:, :2]).any():
            yield f"{key}: '{name}' has an {kind} box without area"


def check_planes(key: str, name: str, image: CameraImage, actors: int) -> Iterator[str]:
    """Check that the planes of an image agree in shape, depths are positive, and instances are among its `actors`."""
    if not _fit(image):
        yield f"{key}: the planes of '{name}' differ in shape"
        return
    if image.depth_m is not None and (np.isnan(image.depth_m).any() or (image.depth_m <= 0).any()):
        yield f"{key}: '{name}' has a depth that is not above 0"
    if image.instance is not None and image.instance.max(initial=0) > actors:
        yield f"{key}: '{name}' shows actor {image.instance.max()} of {actors}"


def _fit(image: CameraImage) -> bool:
    """Return whether the planes of an image have the same height and width."""
    shape = image.rgb.shape[:2]
    others = (image.depth_m, image.semantic, image.instance)
    return image.rgb.shape[2:] == (3,) and all(plane is None or plane.shape == shape for plane in others)


def check_visibility(frame: Frame, name: str, image: CameraImage) -> Iterator[str]:
    """Check that the pixel counts and visible boxes of actors agree with the instance image."""
    truth = frame.annotations
    views = frame.annotations.views[name]
    assert image.instance is not None
    regions = find_actor_regions(image.instance.astype(np.int32), max(len(truth), int(image.instance.max(initial=0))))
    for i in np.flatnonzero(views.pixels != regions.pixels[: len(truth)]):
        yield f"{frame.key}: '{name}' shows {regions.pixels[i]} pixels of '{truth.track[i]}', not {views.pixels[i]}"
    same = np.isclose(views.visible_box, regions.box[: len(truth)], equal_nan=True).all(axis=1)
    for i in np.flatnonzero(~same):
        yield f"{frame.key}: the visible box of '{truth.track[i]}' in '{name}' is not around its pixels"
    for i in np.flatnonzero((views.pixels > 0) & np.isnan(views.amodal_box).any(axis=1)):
        yield f"{frame.key}: '{truth.track[i]}' shows in '{name}' but has no amodal box there"


def check_projection(frame: Frame, name: str, image: CameraImage, lens: Lens) -> Iterator[str]:
    """Check that each actor's pixels lie in its 3D box when back-projected by their depth, and in its amodal box."""
    truth = frame.annotations
    views = frame.annotations.views[name]
    assert image.instance is not None
    assert image.depth_m is not None
    boxes = _boxes_at(frame, frame.calibration.offset_ms.get(name, 0.0) / 1e3)
    rays = compute_pixel_rays(lens).astype(np.float64).reshape(*image.instance.shape, 3)
    for i in np.flatnonzero(views.pixels >= JUDGED):
        v, u = np.nonzero(image.instance == i + 1)
        if len(v) < JUDGED:
            continue  # the annotated count is wrong, which `check_visibility` reports
        chosen = np.linspace(0, len(v) - 1, JUDGED).astype(int)
        v, u = v[chosen], u[chosen]
        # `depth_m` is along the optical axis, so rays are scaled to z = depth.
        points = rays[v, u] * (image.depth_m[v, u] / rays[v, u, 2])[:, None]
        world = transform_points(frame.world_from_sensor(name), points)
        inside = np.count_nonzero(points_in_boxes(world, boxes[[i]], PIXEL_MARGIN_M))
        if inside < PIXELS_INSIDE * JUDGED:
            yield (
                f"{frame.key}: pixels of '{truth.track[i]}' in '{name}' lie outside its box: "
                f"{inside} of {JUDGED} within"
            )
        x1, y1, x2, y2 = views.amodal_box[i] + np.array((-1, -1, 1, 1)) * MARGIN_PX
        if not ((u >= x1) & (u <= x2) & (v >= y1) & (v <= y2)).all():
            yield f"{frame.key}: pixels of '{truth.track[i]}' in '{name}' lie outside its amodal box"


def check_signs(key: str, name: str, signs: SignViews) -> Iterator[str]:
    """Check that annotated signs and lights are unique, with known states, and valid boxes, pixels and distances."""
    if set(signs.state.tolist()) - SIGN_STATES:
        yield f"{key}: '{name}' shows a light in an unknown state; known: {', '.join(sorted(SIGN_STATES))}"
    if not (np.isfinite(signs.box).all() and (signs.box[:, 2:] > signs.box[:, :2]).all()):
        yield f"{key}: '{name}' has a sign whose box has no area"
    if (signs.pixels <= 0).any() or not ((signs.distance_m > 0) & np.isfinite(signs.distance_m)).all():
        yield f"{key}: '{name}' has a sign without pixels, or at no distance"
    if len(np.unique(signs.thing)) < len(signs):
        yield f"{key}: '{name}' shows a sign twice"


def check_placed_signs(key: str, name: str, signs: SignViews, lens: Lens) -> Iterator[str]:
    """Check that the boxes of signs and lights lie in the image."""
    last = (lens.width - 0.5, lens.height - 0.5)
    if ((signs.box < -0.5) | (signs.box > (*last, *last))).any():
        yield f"{key}: '{name}' has a sign whose box does not lie in the image"


def _lens(frame: Frame, name: str, image: CameraImage) -> Lens:
    """Return the lens model of a camera from its calibration; raises `InputError` where values are out of range."""
    fx, fy, cx, cy = frame.calibration.intrinsics[name][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    coefficients = zip(("k1", "k2", "p1", "p2", "k3"), frame.calibration.distortion[name].tolist())
    height, width = image.rgb.shape[:2]
    values = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(coefficients)}
    return parse_config(Lens, values, f"{frame.key}: the calibration of '{name}'")


def _boxes_at(frame: Frame, offset_s: float) -> Boxes:
    """Return the annotated boxes [m, world frame] at `offset_s` [s] after the spin: constant acceleration, same yaw."""
    truth = frame.annotations
    moved: Array = truth.boxes.center + offset_s * truth.velocity + offset_s**2 / 2 * truth.acceleration
    return Boxes(moved, truth.boxes.size, truth.boxes.yaw, truth.boxes.label)


SIGMAS = 6.0  # standard deviations above which an error is reported
EXACT = 1e-6  # tolerance of rounding, in the unit of each error: [m], [degrees], [px], [ms]


def check_calibrations(calibrations: Mapping[str, Calibrations], error: CalibrationError) -> Iterator[str]:
    """Check the agents' true and assumed calibrations, and their differences against the recipe's `error`."""
    for agent, (true, assumed) in calibrations.items():
        for which, calibration in (("true", true), ("assumed", assumed)):
            yield from check_calibration(f"the {which} calibration of {agent}", calibration)
        yield from check_assumed(agent, true, assumed, error)


def check_calibration(name: str, calibration: Calibration) -> Iterator[str]:
    """Check a calibration: rigid mounts, pinhole intrinsics without skew, finite distortion and trigger times.

    `name` names it in the sentences.
    """
    for sensor, mount in calibration.agent_from_sensor.items():
        if not is_rigid(mount):
            yield f"{name}: the mount of '{sensor}' is not a rigid transform"
    for sensor, matrix in calibration.intrinsics.items():
        focal = matrix[[0, 1], [0, 1]]
        skew = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
        if not np.isfinite(matrix).all() or (focal <= 0).any() or skew.any() or matrix[2, 2] != 1:
            yield f"{name}: the intrinsics of '{sensor}' are not those of a camera"
    for sensor, coefficients in calibration.distortion.items():
        if not np.isfinite(coefficients).all():
            yield f"{name}: the distortion of '{sensor}' is not finite"
    for sensor, offset_ms in calibration.offset_ms.items():
        if not np.isfinite(offset_ms):
            yield f"{name}: the trigger time of '{sensor}' is not finite"


def check_assumed(agent: str, true: Calibration, assumed: Calibration, error: CalibrationError) -> Iterator[str]:
    """Check that the assumed calibration of `agent` differs from the true one by at most SIGMAS standard deviations.

    `error` holds the standard deviations [m], [degrees], [px], [ms].
    """
    for sensor in sorted(true.agent_from_sensor.keys() & assumed.agent_from_sensor.keys()):
        if not (is_rigid(true.agent_from_sensor[sensor]) and is_rigid(assumed.agent_from_sensor[sensor])):
            continue
        between = inverse(true.agent_from_sensor[sensor]) @ assumed.agent_from_sensor[sensor]
        turned_deg = np.degrees(np.abs(Rotation.from_matrix(between[:3, :3]).as_rotvec()).max())
        focal_px = 0.0
        if sensor in true.intrinsics and sensor in assumed.intrinsics:
            focal_px = float(np.abs(assumed.intrinsics[sensor] - true.intrinsics[sensor]).max())
        off = {
            "position_m": float(np.abs(between[:3, 3]).max()),
            "rotation_deg": float(turned_deg),
            "focal_px": focal_px,
            "time_ms": abs(assumed.offset_ms.get(sensor, 0.0) - true.offset_ms.get(sensor, 0.0)),
        }
        for name, value in off.items():
            allowed = SIGMAS * getattr(error, name) + EXACT
            if value > allowed:
                yield f"{agent} believes '{sensor}' off by {name} = {value:.4g}, its recipe allows {allowed:.4g}"
