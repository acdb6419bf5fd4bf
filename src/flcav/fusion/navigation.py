"""Vehicles' own navigation: the poses and clocks by which labels of tracks and road sensors reach their frames.

Poses are either the true ones with drawn errors, or estimated from what the vehicle's GNSS receiver and IMU measured.
"""

from typing import Literal

import numpy as np
from pydantic import Field

from flcav.arrays import Array
from flcav.config import Config
from flcav.fusion.sightings import Navigation
from flcav.geometry import pose


class NavigationErrors(Config):
    """Standard deviations of the errors of vehicles' poses and clocks; those of poses are drawn for each frame."""

    position_m: float = Field(default=0.0, ge=0, le=10)  # of a vehicle's position, along x and along y
    heading_deg: float = Field(default=0.0, ge=0, le=45)  # of its heading
    clock_s: float = Field(default=0.0, ge=0, le=1)  # of its clock's offset, one in each scene

    @property
    def stated(self) -> Navigation:
        """Return what a vehicle states of its accuracy."""
        return state_accuracy(self.position_m, float(np.radians(self.heading_deg)))

    def navigate(self, world_from_agent: Array, rng: np.random.Generator) -> Array:
        """Return a vehicle's pose (4, 4) as its navigation has it, with errors drawn from `rng`."""
        off_m, turned = self.position_m * rng.standard_normal(2), np.radians(self.heading_deg) * rng.standard_normal()
        known = world_from_agent @ pose(0, 0, 0, float(turned))
        known[:2, 3] = world_from_agent[:2, 3] + off_m
        return known


ESTIMATED: Literal["estimated"] = "estimated"
PoseSource = NavigationErrors | Literal["estimated"]  # "estimated": see `flcav.fusion.inertial`; clocks are exact


def state_accuracy(position_m: float, heading_rad: float) -> Navigation:
    """Return standard deviations as a vehicle states them: at least a centimetre and .001 rad."""
    return Navigation(max(position_m, 0.01), max(heading_rad, 0.001))
