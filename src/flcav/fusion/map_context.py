"""Headings and classes of objects snapped to the map: lanes say which way cars face, crossings who walks there.

A car on a lane follows its direction within a few degrees, so that the lane is one more measurement of its heading,
joined by inverse variance. Front and back of a car are told apart by few returns, by the lane surely. A slow road user
on a sidewalk or crossing is a pedestrian, one on a lane elsewhere a cyclist; detectors mistake one for the other.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import KDTree
from shapely import STRtree
from shapely.geometry import Polygon

from flcav.arrays import Array
from flcav.fusion.average import YAW, variance_of
from flcav.geometry import Boxes, wrap_angle
from flcav.world.map.layers import MapLane, MapLayers

STEP_M = 1.0  # between two points of a lane's centre line
LANE_RAD = np.radians(4.0)  # standard deviation of a car's heading about its lane's
ALONG_RAD = np.radians(30.0)  # a car that is turned farther from every lane does not follow one: it turns, or is parked
WALKING_MPS = 2.5  # fastest pedestrian
CARS = ("car", "van", "Car")
PEDESTRIAN, CYCLIST = ("pedestrian", "Pedestrian"), ("bicycle", "Cyclist")


@dataclass(frozen=True)
class MapContext:
    """The parts of a town's map that labels are snapped to."""

    points: KDTree  # (Q, 2) points of the centre lines of driving lanes
    yaw: Array  # (Q,) direction of driving there [rad]
    half_width_m: Array  # (Q,)
    walked: STRtree  # sidewalks and crossings


def build_context(layers: MapLayers) -> MapContext:
    """Return the context of a lane-level map; raises ValueError where it has no driving lane."""
    parts = [_sample(lane) for lane in layers.lanes if lane.kind == "driving" and len(lane.centre_line) > 1]
    if not parts:
        raise ValueError("the map has no driving lane")
    rows = np.concatenate(parts)
    areas = [Polygon(outline) for outline in (*layers.sidewalks, *(each.outline for each in layers.crossings))]
    return MapContext(KDTree(rows[:, :2]), rows[:, 2], rows[:, 3], STRtree(areas))


def snap_to_map(boxes: Boxes, velocity: Array, context: MapContext) -> Boxes:
    """Return the boxes (N,), world frame, with headings of cars on lanes and classes of people snapped to the map.

    velocity: (N, 2) [m/s]. Of several lanes at a place, as on a junction, the one nearest to the box's axis counts.
    """
    yaw, variance, label = boxes.yaw.copy(), variance_of(boxes), boxes.label.tolist()
    for row in np.flatnonzero(np.isin(boxes.label, CARS)):
        near = np.array(context.points.query_ball_point(boxes.center[row, :2], r=3.0), dtype=np.int64)
        if not len(near):
            continue
        apart = np.linalg.norm(context.points.data[near] - boxes.center[row, :2], axis=1)
        near = near[apart <= context.half_width_m[near]]
        axis = np.abs((context.yaw[near] - yaw[row] + np.pi / 2) % np.pi - np.pi / 2)
        if not len(near) or axis.min() > ALONG_RAD:
            continue
        lane = context.yaw[near[axis.argmin()]]
        off = (yaw[row] - lane + np.pi / 2) % np.pi - np.pi / 2
        share = LANE_RAD**2 / (LANE_RAD**2 + variance[row, YAW])
        yaw[row] = wrap_angle(lane + share * off)
        variance[row, YAW] *= share
    people = np.flatnonzero(np.isin(boxes.label, (*PEDESTRIAN, *CYCLIST)))
    walked = np.zeros(len(people), dtype=bool)
    walked[context.walked.query(shapely.points(boxes.center[people, :2]), predicate="within")[0]] = True
    slow = np.hypot(*velocity[people].T) <= WALKING_MPS
    for row, on_foot, fast in zip(people, walked, ~slow, strict=True):
        names = PEDESTRIAN if on_foot and not fast else CYCLIST
        if on_foot != fast:  # the map and the speed agree
            label[row] = names[0 if label[row] in (PEDESTRIAN[0], CYCLIST[0]) else 1]
    return replace(boxes, yaw=yaw, label=np.array(label, dtype=np.str_), variance=variance)


def _sample(lane: MapLane) -> Array:
    """Return (Q, 4) points of a lane: x, y, direction, half the width."""
    steps = np.diff(lane.centre_line, axis=0)
    lengths = np.hypot(*steps.T)
    counts = np.maximum(np.ceil(lengths / STEP_M).astype(int), 1)
    number = np.repeat(np.arange(len(steps)), counts)
    share = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[number]
    xy = lane.centre_line[:-1][number] + share[:, None] * steps[number]
    yaw = np.arctan2(steps[:, 1], steps[:, 0])[number]
    return np.column_stack((xy, yaw, np.full(len(xy), lane.width_m / 2)))
