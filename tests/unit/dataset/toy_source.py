"""A source of small hand-made frames, quick enough for tests of everything around it."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flcav.geometry import Boxes, pose
from flcav.sensors.frame import Annotations, Calibration, Frame
from flcav.statistics.streams import stream

MOUNT = pose(0.1, 0.0, 1.8, yaw=0.01)


@dataclass(frozen=True)
class ToySource:
    """Two agents among a few cars; it can be slow, fail at a spin as a full disk does, or kill its process."""

    seed: int = 0
    scene_count: int = 2
    spins: int = 3
    pause_s: float = 0.0
    fail_at: int | None = None
    split: str = "train"
    die: bool = False

    def describe(self) -> dict[str, Any]:
        return {
            "town": "toy",
            "seed": self.seed,
            "split": self.split,
            "scenes": self.scene_count,
            "spins_per_scene": self.spins,
        }

    def scenes(self) -> list[str]:
        return [f"toy-{self.seed}-{scene:03d}" for scene in range(self.scene_count)]

    def frame_count(self, scene: str) -> int:
        return 2 * self.spins

    def frames(self, scene: str) -> Iterator[Frame]:
        for index in range(self.spins):
            for agent in ("cav0", "pole3"):
                time.sleep(self.pause_s)
                if self.die:
                    os.kill(os.getpid(), signal.SIGKILL)
                if self.fail_at == index:
                    raise OSError(28, "No space left on device")
                yield toy_frame(self.seed, scene, index, agent)

    def trace(self, scene: str) -> None:
        return None


def toy_frame(seed: int, scene: str, index: int, agent: str) -> Frame:
    """Return a frame of 4 boxes: each full of points but the last, which has none."""
    generator = stream(seed, scene, index, agent)
    world_from_agent = pose(*generator.uniform(-100, 100, 2), yaw=generator.uniform(-3, 3))
    local = np.array(
        [[8.0, 2, 1, 4, 2, 2, 0.3], [20, -5, 1, 4, 2, 2, 2], [-9, 9, 1, 0.6, 0.6, 2, 0], [30, 9, 1, 4, 2, 2, 1]]
    )
    truth = Boxes.from_array(local, ["car", "van", "pedestrian", "car"]).transform(world_from_agent)
    returns = np.array([40, 20, 5, 0])
    corners = Boxes.from_array(local, "car")
    inside = np.concatenate(
        [
            generator.uniform(-0.25, 0.25, (count, 3)) * box.size + box.center
            for count, box in zip(returns, (corners[[i]] for i in range(4)))
        ]
    )
    ground = np.column_stack((generator.uniform(-40, 40, (60, 2)), np.zeros(60)))
    agent_points = np.concatenate((inside, ground))
    points = np.linalg.inv(MOUNT) @ np.column_stack((agent_points, np.ones(len(agent_points)))).T
    lidar = np.column_stack((points.T[:, :3], generator.uniform(0, 1, len(agent_points)))).astype(np.float32)
    annotations = Annotations(
        track=np.array(["veh0", "veh1", "ped0", "veh2"]),
        boxes=truth,
        velocity=generator.normal(size=(4, 3)),
        acceleration=generator.normal(size=(4, 3)),
        returns=returns,
        occlusion=np.array([0.0, 0.2, 0.5, 1.0]),
    )
    mounts = Calibration({"lidar": MOUNT})
    return Frame(scene, index, 10 + 0.5 * index, agent, world_from_agent, mounts, mounts, {"lidar": lidar}, annotations)
