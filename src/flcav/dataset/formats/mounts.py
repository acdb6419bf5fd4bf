"""Mounts of sensors and motion of agents in terms of other formats.

Assignment of cameras and radars to named channels by their direction, rotations as quaternions, and agents' velocities.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from flcav.dataset.formats.reading import difference_tracks
from flcav.dataset.store import Dataset
from flcav.geometry import wrap_angle

LEVEL_RAD = np.radians(2.0)  # largest tilt of a level camera
AHEAD_RAD = np.radians(30.0)  # largest yaw of a camera that looks ahead


def optical_yaw(agent_from_camera: NDArray[np.float64]) -> float:
    """Return the yaw [rad] of a camera's optical axis (z of its optical frame), counter-clockwise from straight ahead.

    `agent_from_camera` is (4, 4).
    """
    return float(np.arctan2(agent_from_camera[1, 2], agent_from_camera[0, 2]))


def is_level(agent_from_camera: NDArray[np.float64]) -> bool:
    """Return whether the y axis of a camera's optical frame points down, to LEVEL_RAD."""
    return bool(-agent_from_camera[2, 1] >= np.cos(LEVEL_RAD))


def find_front_camera(agent_from_camera: Mapping[str, NDArray[np.float64]]) -> str | None:
    """Return the name of the level camera with the least yaw, None if none is within AHEAD_RAD."""
    turned = {name: abs(optical_yaw(mount)) for name, mount in agent_from_camera.items() if is_level(mount)}
    name = min(turned, key=turned.__getitem__, default=None)
    return name if name is not None and turned[name] <= AHEAD_RAD else None


def assign_channels(yaw: Mapping[str, float], named: Mapping[str, float]) -> dict[str, str]:
    """Return sensor -> channel, the assignment with the least sum of angles between them.

    `yaw` are the directions [rad] of the sensors, `named` those of the channels. Sensors in excess of the channels are
    left out.
    """
    sensors, known = list(yaw), list(named)
    away = np.abs(wrap_angle(np.subtract.outer([yaw[name] for name in sensors], [named[name] for name in known])))
    rows, columns = linear_sum_assignment(away.reshape(len(sensors), len(known)))
    return {sensors[row]: known[column] for row, column in zip(rows, columns)}


def quaternion(matrix: NDArray[np.float64]) -> list[float]:
    """Return the unit quaternion [w, x, y, z], w >= 0, of the rotation in a (3, 3) or (4, 4) transform."""
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def agent_velocities(dataset: Dataset, scene: str) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Return (agent, spin) -> (3,) velocity, world frame [m/s]; zero for an agent outside the traffic, as a pole.

    In an imported dataset velocities are differences of an agent's poses, zero where there are none to be compared.
    """
    frames = dataset.select(scenes=[scene])
    keys = [dataset.keys[i] for i in frames]
    if dataset.manifest.imported:
        places = np.array([dataset.world_from_agent(i)[:3, 3] for i in frames])
        moved = difference_tracks(
            np.array([key.agent for key in keys]), np.array([key.time_s for key in keys]) - keys[0].time_s, places
        )
        return {(key.agent, key.index): each for key, each in zip(keys, np.nan_to_num(moved))}
    velocities = {(key.agent, key.index): np.zeros(3) for key in keys}
    trace = dataset.trace(scene)
    if trace is None:
        return velocities
    actors = {name: a for a, name in enumerate(trace.actor.tolist())}
    for key in keys:
        if key.agent in actors:
            t = int(np.argmin(np.abs(trace.time_s - key.time_s)))
            velocities[key.agent, key.index] = trace.velocity[t, actors[key.agent]]
    return velocities
