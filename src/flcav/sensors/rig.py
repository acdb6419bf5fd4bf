"""Rigs: which sensors an agent carries, and where."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.geometry import pose
from flcav.sensors.lidar import Lidar


class Mount(Config):
    """A sensor's pose on its agent. A positive pitch turns it downwards."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def agent_from_sensor(self) -> NDArray[np.float64]:
        """Return the (4, 4) transform."""
        yaw, pitch, roll = np.radians((self.yaw_deg, self.pitch_deg, self.roll_deg))
        return pose(self.x, self.y, self.z, yaw, pitch, roll)


class MountedLidar(Config):
    """A LiDAR and where it is."""

    mount: Mount = Mount()
    settings: Lidar = Lidar()


class Rig(Config):
    """The sensors of one agent, by name. A car's frame is at its ground centre, a pole's at its mount."""

    lidars: dict[str, MountedLidar] = Field(min_length=1)

    def range_m(self) -> float:
        """Return how far the farthest-seeing sensor sees."""
        return max(lidar.settings.range_m for lidar in self.lidars.values())


def car() -> Rig:
    """Return one 32-channel LiDAR above the roof."""
    return Rig(lidars={"lidar": MountedLidar(mount=Mount(z=1.85), settings=Lidar(channels=32, azimuth_steps=900))})


def roadside() -> Rig:
    """Return one 64-channel LiDAR at a pole's mount, seeing all round and far down."""
    settings = Lidar(channels=64, azimuth_steps=1024, range_m=100.0, up_deg=2.0, down_deg=-45.0, sensitivity_m=400.0)
    return Rig(lidars={"lidar": MountedLidar(settings=settings)})


RIGS: dict[str, Rig] = {"car": car(), "roadside": roadside()}
