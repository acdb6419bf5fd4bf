"""Sightings: the boxes, the posts and the pose of one agent in one spin, and what of them it tells others."""

from dataclasses import dataclass, field, replace

import numpy as np

from flcav.arrays import Array
from flcav.fusion.average import YAW, BoxReport, variance_of
from flcav.geometry import Boxes


@dataclass(frozen=True)
class Navigation:
    """Standard deviations of a vehicle's own pose and clock, as its navigation states them."""

    position_m: float
    heading_rad: float


@dataclass(frozen=True)
class Sighting:
    """Observation of one agent in one spin: its pose by navigation, boxes and posts."""

    agent: str
    time_s: float  # by its clock
    world_from_agent: Array  # (4, 4) by its navigation; of a road sensor as surveyed
    boxes: Boxes  # agent's frame, its origin on the ground, with scores and variances
    posts: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (L, 2) feet of posts, agent's frame [m]
    navigation: Navigation | None = None  # None: surveyed, a road sensor


def tell(sighting: Sighting) -> BoxReport:
    """Return what an agent tells of a spin: boxes in the world, with the uncertainty of its pose in their variances.

    A heading error moves a box at distance r by r times the error, across the line of sight.
    """
    boxes = sighting.boxes.transform(sighting.world_from_agent)
    return BoxReport(sighting.agent, sighting.time_s, add_pose_variance(boxes, sighting))


def add_pose_variance(boxes: Boxes, sighting: Sighting) -> Boxes:
    """Return boxes, world frame, with the variance of an agent's pose added to theirs; of road sensors as they are."""
    if sighting.navigation is None:
        return boxes
    known, variance = sighting.navigation, variance_of(boxes)
    arm = boxes.center[:, :2] - sighting.world_from_agent[:2, 3]
    variance[:, :2] += known.position_m**2 + (arm[:, ::-1] * known.heading_rad) ** 2
    variance[:, YAW] += known.heading_rad**2
    return replace(boxes, variance=variance)
