"""Rigid transforms and oriented 3D boxes."""

from flcav.geometry.boxes import Boxes, concatenate, points_in_boxes
from flcav.geometry.poses import inverse, is_rigid, pose, transform_points, wrap_angle, yaw_of

__all__ = [
    "Boxes",
    "concatenate",
    "inverse",
    "is_rigid",
    "points_in_boxes",
    "pose",
    "transform_points",
    "wrap_angle",
    "yaw_of",
]
