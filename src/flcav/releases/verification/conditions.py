"""Conditions that sensors meet on roads: range noise, lost returns, a turned mount, and late detections.

Each takes a recorded frame and returns it as it would have been; the objects to be found stay the same.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import inverse, pose
from flcav.sensors.frame import Frame
from flcav.statistics.streams import stream

NOISE_M = 0.05  # standard deviation of each coordinate
DROPPED = 0.5  # share of the returns
TURNED_RAD = (0.01, 0.005)  # of the LiDAR: yaw and pitch, unknown to the vehicle
LIFTED_M = 0.05
LATE_S = 0.2  # from the spin until detections are used

PLAIN = "plain"
Condition = Callable[[Frame], Frame]
Points = NDArray[np.float32]


def add_noise(frame: Frame) -> Frame:
    """Return the frame with Gaussian noise on each coordinate of its points."""
    rng = stream(0, "noise", frame.key)

    def noisy(points: Points) -> Points:
        shifted = points.copy()
        shifted[:, :3] += rng.normal(0, NOISE_M, (len(points), 3))
        return shifted

    return _change(frame, noisy)


def drop_returns(frame: Frame) -> Frame:
    """Return the frame without a random share of its returns."""
    rng = stream(0, "drop-out", frame.key)
    return _change(frame, lambda points: points[rng.random(len(points)) >= DROPPED])


def turn_mount(frame: Frame) -> Frame:
    """Return the frame of a LiDAR that was turned and lifted, which the vehicle does not know."""
    seen = inverse(pose(0, 0, LIFTED_M, *TURNED_RAD))

    def turned(points: Points) -> Points:
        out = points.copy()
        out[:, :3] = points[:, :3] @ seen[:3, :3].T + seen[:3, 3]
        return out

    return _change(frame, turned)


def move_on(frame: Frame) -> Frame:
    """Return the frame with its objects where they are when late detections are used, by their velocities."""
    known = frame.annotations
    velocity = np.nan_to_num(known.velocity)
    boxes = replace(known.boxes, center=known.boxes.center + LATE_S * velocity)
    return replace(frame, annotations=replace(known, boxes=boxes))


CONDITIONS: Mapping[str, Condition] = {
    "noise": add_noise,
    "drop-out": drop_returns,
    "miscalibration": turn_mount,
    "latency": move_on,
}
WORDS = {
    "noise": f"{NOISE_M * 100:g} cm noise on every point",
    "drop-out": f"{DROPPED:.0%} of the returns lost",
    "miscalibration": f"LiDAR turned by {np.degrees(TURNED_RAD[0]):.1f} degrees, tilted by "
    f"{np.degrees(TURNED_RAD[1]):.1f}, lifted by {LIFTED_M * 100:g} cm",
    "latency": f"detections used {LATE_S:g} s late",
}


def _change(frame: Frame, change: Callable[[Points], Points]) -> Frame:
    return replace(frame, lidar={name: change(points) for name, points in frame.lidar.items()})
