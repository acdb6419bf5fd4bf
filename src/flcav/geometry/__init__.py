"""Rigid transforms and oriented 3D boxes."""

from flcav.geometry.boxes import (
    Boxes,
    concatenate,
    count_points_in_boxes,
    points_in_boxes,
    segments_meet_boxes,
    spread_over_footprints,
    turned_boxes,
)
from flcav.geometry.poses import (
    Array as Array,
)
from flcav.geometry.poses import (
    angles_of,
    heading_vectors,
    inverse,
    is_rigid,
    left_vectors,
    pose,
    rotate,
    rotations,
    rotations_about_z,
    transform_points,
    unit_vectors,
    wrap_angle,
    yaw_of,
)

__all__ = [
    "Boxes",
    "angles_of",
    "concatenate",
    "count_points_in_boxes",
    "heading_vectors",
    "inverse",
    "is_rigid",
    "left_vectors",
    "points_in_boxes",
    "pose",
    "rotate",
    "rotations",
    "rotations_about_z",
    "segments_meet_boxes",
    "spread_over_footprints",
    "transform_points",
    "turned_boxes",
    "unit_vectors",
    "wrap_angle",
    "yaw_of",
]
