"""Recordings of several drives in which one vehicle sees one frame."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flcav.geometry import Boxes, pose
from flcav.sensors.frame import Annotations, Calibration, Frame


def make_frame() -> Frame:
    """Return a frame of a LiDAR with a car that drives east at 10 m/s."""
    rng = np.random.default_rng(0)
    mounts = Calibration({"lidar": pose(0, 0, 1.8)}, {})
    known = Annotations(
        track=np.array(["car1"]),
        boxes=Boxes(np.array([[10.0, 0, 0.8]]), np.array([[4.4, 1.8, 1.6]]), np.zeros(1), np.array(["car"])),
        velocity=np.array([[10.0, 0, 0]]),
        acceleration=np.zeros((1, 3)),
        returns=np.array([20]),
        occlusion=np.zeros(1),
    )
    points = rng.uniform(-20, 20, (500, 4)).astype(np.float32)
    points[:, 3] = 0.5
    return Frame("s", 0, 0.0, "cav0", np.eye(4), mounts, mounts, {"lidar": points}, known)


@dataclass(frozen=True)
class Drives:
    """A source of so many scenes."""

    seen: Frame
    count: int

    def describe(self) -> dict[str, Any]:
        return {"town": "none", "split": "test", "seed": 0}

    def scenes(self) -> list[str]:
        return [f"s{number}" for number in range(self.count)]

    def frame_count(self, scene: str) -> int:
        return 1

    def frames(self, scene: str) -> Iterator[Frame]:
        yield replace(self.seen, scene=scene)

    def trace(self, scene: str) -> None:
        return None
