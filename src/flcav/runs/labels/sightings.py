"""Sightings of vehicles: poses and clocks by their navigation, and the boxes that they detect."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from flcav.config import InputError
from flcav.dataset.layout import navigation_path
from flcav.dataset.store import Dataset
from flcav.fusion.average import ESTIMATED, Navigation, PoseSource, Sighting, state_accuracy
from flcav.fusion.distillation import TOLD, Distillation
from flcav.fusion.inertial import MotionEstimate, Mounts, estimate_drive
from flcav.fusion.pose_graph import segment_posts
from flcav.geometry import Boxes, transform_points
from flcav.geometry.arrays import Array
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar
from flcav.sensors.frame import Frame
from flcav.statistics.streams import stream
from flcav.world.map.town import Town

KEPT_DRIVES = 64  # drives whose estimated poses are cached


def navigate(data: Dataset, i: int, how: PoseSource) -> tuple[Array, Navigation]:
    """Return the pose of the vehicle in frame `i` by its navigation, and the accuracy that it states.

    The pose is world_from_agent (4, 4) [m]. Estimated poses need the navigation log of the drive; raises `InputError`
    where there is none, or it is damaged.
    """
    key = data.keys[i]
    if how == ESTIMATED:
        number, drive = _estimate(data, key.scene, key.agent)
        position_m, heading_rad = drive.deviation[number[i]].tolist()
        return drive.world_from_agent[number[i]], state_accuracy(position_m, heading_rad)
    # Errors depend on the recording alone, not on the run: arms that are compared see the same ones.
    rng = stream(0, "navigation", str(data.manifest.recipe.get("seed")), key.scene, key.index, key.agent)
    return how.navigate(data.world_from_agent(i), rng), how.stated


def draw_clock_offset(data: Dataset, i: int, how: PoseSource) -> float:
    """Return the clock offset [s] of the vehicle in frame `i`, positive if ahead; 0 with a GNSS receiver."""
    if how == ESTIMATED:
        return 0.0
    key = data.keys[i]
    rng = stream(0, "clock", str(data.manifest.recipe.get("seed")), key.scene, key.agent)
    return how.clock_s * float(rng.standard_normal())


def make_sighting(
    network: Second, data: Dataset, i: int, how: Distillation, poses: PoseSource
) -> tuple[Sighting, Boxes]:
    """Return the message of the vehicle in frame `i` (vehicle frame), and its detections in the LiDAR frame."""
    key, frame = data.keys[i], data.frame(i)
    (found,) = detect_in(network, [frame], score_threshold=TOLD)
    boxes = found.transform(frame.assumed.agent_from_sensor[choose_lidar(frame)])
    (known, stated), posts = navigate(data, i, poses), find_told_posts(frame, how)
    return Sighting(key.agent, key.time_s + draw_clock_offset(data, i, poses), known, boxes, posts, stated), found


def find_told_posts(frame: Frame, how: Distillation) -> Array:
    """Return the feet (L, 2) of the posts that a vehicle reports, vehicle frame [m]; none without a pose graph."""
    if not how.pose_graph:
        return np.zeros((0, 2))
    lidar = choose_lidar(frame)
    return segment_posts(transform_points(frame.assumed.agent_from_sensor[lidar], frame.lidar[lidar][:, :3]), 0.0)


@lru_cache(maxsize=KEPT_DRIVES)
def _estimate(data: Dataset, scene: str, agent: str) -> tuple[Mapping[int, int], MotionEstimate]:
    """Return the rows by frame number, and the estimated poses, of a vehicle's drive through a scene.

    They are estimated from the whole drive at once, and cached for its other frames.
    """
    path = data.folder / navigation_path(scene)
    town = _find_town(data)
    log = data.navigation_logs(scene).get(agent)
    if log is None:
        raise InputError(f"{path}: no navigation log of '{agent}'; estimated poses need 'navigation_s' in its recipe")
    if town is None:
        raise InputError(f"{data.folder}: estimated poses need the town's map, which is not known")
    frames = data.select(scenes=[scene], agents=[agent])
    mounts = data.calibrations[agent].assumed.agent_from_sensor
    if missing := {log.gnss, log.imu} - set(mounts):
        raise InputError(f"{path}: the log of '{agent}' is of '{min(missing)}', which its calibration lacks")
    ground = town.grounds if town.relief is None else town.relief.sole_heights
    times_s = np.array([data.keys[i].time_s for i in frames])
    try:
        drive = estimate_drive(log, Mounts(mounts[log.gnss], mounts[log.imu]), town.geo, ground, times_s)
    except InputError as error:
        raise InputError(f"{path}: '{agent}': {error}") from None
    return {i: row for row, i in enumerate(frames)}, drive


@lru_cache(maxsize=4)
def _find_town(data: Dataset) -> Town | None:
    return data.town()
