"""A second modality beside the LiDAR: echoes of radars among the points, or points painted by the camera's network.

A cloud has a row per point, in the frame of the LiDAR: x, y, z [m] and intensity, and the columns of the network's
second modality (`COLUMNS`). An echo is a row of its own with intensity `ECHO`, its range rate over ground [m/s] and its
cross-section [dBsm]; a painted point has the scores of `PAINT_CLASSES`, which sum to 1 (Vora et al., "PointPainting",
CVPR 2020). All else is 0, so that a point that no camera shows, and a sweep whose second sensor has failed, look alike.

Echoes are placed `ECHO_M` above the ground, since a radar's elevation is too coarse for a height. Range rates are made
those over ground by the vehicle's own velocity, estimated from the echoes, most of which are of what stands (Kellner et
al., "Instantaneous ego-motion estimation using Doppler radar", ITSC 2013).
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from flcav.arrays import Array, Array32
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points
from flcav.perception.agents import frame_reader
from flcav.perception.images import find_view
from flcav.perception.objects.config import COLUMNS, ECHO, SWEEP_COLUMNS, SecondConfig
from flcav.perception.objects.painter import load_painter, paint
from flcav.perception.objects.truth import choose_lidar
from flcav.sensors.frame import Frame
from flcav.sensors.radar import compute_echo_directions

ECHO_M = 0.5  # height above the ground at which echoes are placed
SPIN_MS = 100.0  # most that the trigger of a second sensor is away from the LiDAR's
FEWEST = 8  # echoes from which the vehicle's own velocity is estimated
RATE_M_S = 0.3  # error of a range rate at which an echo has half of its weight (Cauchy)
STEPS = 12  # of the reweighted least squares
DARK = 8  # brightest value of a picture that shows nothing, as of a camera that has failed
SENSOR = {"radar": "radar", "painted": "camera"}


def frames_beside(data: Dataset, config: SecondConfig, numbers: Sequence[int]) -> Callable[[int], Frame]:
    """Return the function that reads a frame as a network of `config` sees it, see `frame_reader`.

    Raises `InputError` where no frame of the dataset has the network's second modality, or where a sensor of it
    triggers more than `SPIN_MS` from the LiDAR in one of `numbers`. Frames that lack it, as those of a vehicle without
    that sensor, are seen as if it had failed.
    """
    if config.beside:
        sensors_of = data.radars if config.beside == "radar" else data.cameras
        if not any(sensors_of(number) for number in range(len(data))):
            kind = SENSOR[config.beside]
            raise InputError(f"{data.folder}: no {kind} in its frames, which the network reads beside the LiDAR")
        for agent, number in {data.keys[number].agent: number for number in numbers}.items():
            triggers = data.calibrations[agent].assumed.offset_ms
            spin_ms = max((triggers.get(lidar, 0.0) for lidar in data.lidars(number)[:1]), default=0.0)
            for sensor in sensors_of(number):
                if not abs(away_ms := triggers.get(sensor, 0.0) - spin_ms) <= SPIN_MS:
                    raise InputError(
                        f"{data.folder}: clocks disagree: {agent}'s '{sensor}' is {away_ms:g} ms after its LiDAR, "
                        f"and a spin takes {SPIN_MS:g} ms"
                    )
    return frame_reader(data, config.foreground)


def refuse_files(config: SecondConfig, origin: Path) -> None:
    """Raise `InputError` for a network that reads a second modality, which point clouds of files do not have."""
    if config.beside:
        sensor = SENSOR[config.beside]
        raise InputError(f"{origin}: no {sensor} beside the points, which the network reads; give a dataset")


def read_cloud(frame: Frame, config: SecondConfig, lidar: str | None = None) -> Array32:
    """Return the cloud (N, config.columns) of a frame, in the frame of its LiDAR (None: its first).

    Raises `InputError` where it has no such LiDAR.
    """
    name = choose_lidar(frame, lidar)
    sweep = frame.lidar[name]
    if config.beside == "radar":
        return np.concatenate((widen(sweep, config.columns), place_echoes(frame, name)))
    if config.beside == "painted":
        return np.column_stack((sweep, paint_points(frame, name)))
    return sweep


def widen(cloud: Array32, columns: int) -> Array32:
    """Return the cloud (N, C) with `columns` columns, those it lacks 0: as of a second sensor that has failed."""
    return cloud if cloud.shape[1] == columns else np.pad(cloud, ((0, 0), (0, columns - cloud.shape[1])))


def blind(cloud: Array32) -> Array32:
    """Return the cloud (N, C) without what its second modality has added: no echoes, nothing painted."""
    kept = cloud[cloud[:, 3] != ECHO]
    kept[:, SWEEP_COLUMNS:] = 0
    return kept


def place_echoes(frame: Frame, lidar: str) -> Array32:
    """Return the echoes (N, 6) of all radars as rows of a cloud: x, y, z [m], ECHO, range rate over ground, dBsm."""
    rows = [np.zeros((0, SWEEP_COLUMNS + COLUMNS["radar"]), np.float32)]
    for name, echoes in frame.radar.items():
        agent_from_radar = frame.assumed.agent_from_sensor[name]
        ahead = compute_echo_directions(echoes)
        place = transform_points(agent_from_radar, echoes[:, :1] * ahead)
        place[:, 2] = ECHO_M
        place = transform_points(inverse(frame.assumed.agent_from_sensor[lidar]), place)
        rate = echoes[:, 3] + ahead @ estimate_velocity(ahead, echoes[:, 3].astype(np.float64))
        rows.append(np.column_stack((place, np.full(len(place), ECHO), rate, echoes[:, 4])).astype(np.float32))
    return np.concatenate(rows)


def estimate_velocity(ahead: Array, rate: Array) -> Array:
    """Return the velocity (3,) [m/s] of a radar by its echoes, radar frame, z = 0.

    Args:
        ahead: (N, 3) unit vectors to the echoes, radar frame.
        rate: (N,) range rates [m/s], positive for receding; those of what stands are -ahead @ velocity.

    Reweighted least squares by Cauchy's weights, from the median of the forward speeds that single echoes imply. Zero
    with fewer than `FEWEST` echoes.
    """
    if len(rate) < FEWEST:
        return np.zeros(3)
    plane = ahead[:, :2]
    velocity = np.array([np.median(-rate / np.maximum(plane[:, 0], 0.2)), 0.0])
    for _ in range(STEPS):
        weight = 1 / (1 + ((rate + plane @ velocity) / RATE_M_S) ** 2)
        normal = plane.T @ (weight[:, None] * plane) + 1e-3 * np.diag((0.0, 1.0))  # sideways motion is small
        velocity = np.linalg.solve(normal, -plane.T @ (weight * rate))
    return np.append(velocity, 0.0)


def paint_points(frame: Frame, lidar: str) -> Array32:
    """Return the scores (N, classes) of the points of a LiDAR by the camera that looks ahead of it.

    They are 0 for points out of the picture, and for all where there is no camera or its picture is black.
    """
    sweep = frame.lidar[lidar]
    scores = np.zeros((len(sweep), COLUMNS["painted"]), np.float32)
    view = find_view(frame, lidar)
    if view is None or view.picture.max() <= DARK:
        return scores
    shown = np.flatnonzero(view.shows(sweep[:, :3]))
    scores[shown] = paint(load_painter(), view.picture, view.project(sweep[shown, :3]))
    return scores
