"""Obstacles of no class: returns that stand on the lanes and that no detection explains, such as those of trucks.

The detector has the classes cars, pedestrians and cyclists; a vehicle has to stop before anything. Returns above the
ground of the map, on the lanes, are clustered on a grid in plan (connected components); each cluster is a box. Returns
of fog and rain are told apart by intensity (Park, Kim, Kim, "Fast and accurate desnowing algorithm for LiDAR point
clouds", IEEE Access 8, 2020) and by density.
"""

from dataclasses import replace

import numpy as np
import shapely
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array, Array32, Ints
from flcav.geometry import Boxes, points_in_boxes, rotate, wrap_angle
from flcav.world.map.town import Town

OBSTACLE = "Obstacle"  # label of the boxes
REACH_M = 35.0  # beyond it returns of one object are far apart
LOW_M, HIGH_M = 0.5, 2.5  # heights above the ground: above kerbs and spray, below crowns of trees
EXPLAINED_M = 0.7  # around a detection, whose returns are its own
CELL_M = 0.5  # of the grid; returns in adjacent cells are of one obstacle
LEAST = 5  # returns of an obstacle
AIR_M, FAINT = 16.0, 0.002  # nearer returns of this intensity or less are of fog and drops (Park et al., 2020)
DENSE = 300.0  # least returns of an obstacle in a cell, times its squared distance [m^2]: drops of rain give fewer
LEAST_M = 0.5  # length and width of the smallest box
ANGLES = np.linspace(0, np.pi / 2, 45, endpoint=False)  # orientations that are tried [rad]
CLOSEST_M = 0.05  # to a side of the rectangle, so that single returns do not decide
SIGMA_M = 0.3  # standard deviation of a box, since the side that is seen moves with the vehicle


def clear_air(sweep: Array32) -> Array32:
    """Return a sweep (N, 4) in the LiDAR's frame, x, y, z [m] and intensity, without the returns of fog and drops."""
    return sweep[(np.linalg.norm(sweep[:, :3], axis=1) > AIR_M) | (sweep[:, 3] > FAINT)]


def find_obstacles(points: Array, sensor: Array, detected: Boxes, lanes: BaseGeometry, town: Town) -> Boxes:
    """Return boxes of obstacles on the lanes within `REACH_M` of a LiDAR, labelled `OBSTACLE`; all in the world frame.

    points: (N, 3) of a sweep [m]; sensor: x, y of the LiDAR [m]; `lanes`: the area of the driving lanes of `town`. A
    box is a rectangle in plan around the returns of a cluster: of the sides that the LiDAR sees.
    """
    away = np.hypot(*(points[:, :2] - sensor).T)
    near = points[away < REACH_M, :3]
    near = near[shapely.contains_xy(lanes, near[:, 0], near[:, 1])]
    above = near[:, 2] - town.grounds(near[:, 0], near[:, 1])
    kept = (above > LOW_M) & (above < HIGH_M) & ~points_in_boxes(near, detected, EXPLAINED_M).any(axis=0)
    near, above = near[kept], above[kept]
    rows = []
    for of_one in _cluster(near[:, :2], np.hypot(*(near[:, :2] - sensor).T)):
        if len(of_one) >= LEAST:
            x, y, length, width, yaw = _fit_rectangle(near[of_one, :2])
            height, ground = above[of_one].max(), near[of_one[0], 2] - above[of_one[0]]
            rows.append((x, y, ground + height / 2, max(length, LEAST_M), max(width, LEAST_M), height, yaw))
    boxes = Boxes.from_array(np.array(rows).reshape(-1, 7), OBSTACLE, np.ones(len(rows)))
    return replace(boxes, variance=np.full((len(rows), 7), SIGMA_M**2))


def _fit_rectangle(plan: Array) -> tuple[float, float, float, float, float]:
    """Return the rectangle around points (N, 2) [m] that lie near its sides: x, y, length, width [m], yaw [rad].

    Its orientation maximises the closeness of Zhang et al., "Efficient L-shape fitting for vehicle detection using
    laser scanners", IV 2017, algorithm 3.
    """
    cos, sin = np.cos(ANGLES)[:, None], np.sin(ANGLES)[:, None]
    turned = np.stack((plan[:, 0] * cos + plan[:, 1] * sin, plan[:, 1] * cos - plan[:, 0] * sin))  # (2, A, N)
    low, high = turned.min(axis=2, keepdims=True), turned.max(axis=2, keepdims=True)
    away = np.minimum(turned - low, high - turned).min(axis=0)
    best = int((1 / np.maximum(away, CLOSEST_M)).sum(axis=1).argmax())
    (along, across), (length, width) = ((low + high) / 2)[:, best, 0], (high - low)[:, best, 0]
    x, y = rotate(float(along), float(across), float(ANGLES[best]))
    yaw = ANGLES[best] + (np.pi / 2 if width > length else 0.0)
    return x, y, max(length, width), min(length, width), float(wrap_angle(yaw))


def _cluster(plan: Array, away: Array) -> list[Ints]:
    """Return the rows of each cluster of points (N, 2) in plan, which are `away` (N,) from the LiDAR [m]."""
    if not len(plan):
        return []
    cell = np.floor((plan - plan.min(axis=0)) / CELL_M).astype(np.int64)
    shape = cell.max(axis=0) + 1
    share = np.zeros(shape)  # of the returns that make an obstacle
    np.add.at(share, tuple(cell.T), away**2 / DENSE)
    taken = share >= 1
    named = np.zeros(shape, np.int64)
    ndimage.label(taken, np.ones((3, 3)), named)
    of = named[tuple(cell.T)]
    return [np.flatnonzero(of == number) for number in range(1, of.max() + 1)]
