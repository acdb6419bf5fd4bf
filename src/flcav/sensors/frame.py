"""The typed contract between whatever observes and whatever records or learns."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Annotations:
    """Ground truth of one frame: every actor within the sensors' range but the agent itself, hit or not."""

    track: NDArray[np.str_]  # (M,) track ids, stable over a scene
    boxes: Boxes  # (M,) world frame; label = actor category (car, van, truck, ...)
    velocity: Array  # (M, 3) world [m/s]
    returns: NDArray[np.int64]  # (M,) LiDAR returns from the actor in this frame's sweep
    occlusion: Array  # (M,) 1 - visible / unoccluded rays; 1 where nothing of it is visible

    def __len__(self) -> int:
        return len(self.track)


@dataclass(frozen=True)
class Frame:
    """Everything one agent observes at one LiDAR spin."""

    scene: str  # one scene is one traffic run; frames of different scenes share no traffic
    index: int  # spin number within the scene; agents of one scene share it
    time_s: float  # simulation time of the spin
    agent: str  # "cav0", "pole3"
    world_from_agent: Array  # (4, 4)
    agent_from_sensor: Mapping[str, Array]  # sensor name -> (4, 4)
    lidar: Mapping[str, NDArray[np.float32]]  # LiDAR name -> (N, 4) x, y, z [m], intensity [0, 1]; sensor frame
    annotations: Annotations

    @property
    def key(self) -> str:
        """Return the name of this frame, unique in a dataset and safe in a file name."""
        return f"{self.scene}_{self.index:04d}_{self.agent}"

    def world_from_sensor(self, name: str) -> Array:
        """Return the (4, 4) transform of sensor `name` to the world."""
        return self.world_from_agent @ self.agent_from_sensor[name]
