"""Labels by federated distillation: vehicles send boxes to the edge server, and learn from the road average.

Wang et al. (IEEE Network 37(3), 2023): road sensors and vehicles send boxes with their uncertainties to the edge
server, which averages them over a window of spins (`flcav.fusion.average`); each vehicle learns from the average at
the time of its own frame. The window is centred on the frame, since labels are made after the drive. Ground truth is
not available, and a vehicle's pose and time are those of its navigation.

- A box of the average is a label if a road sensor has it in half of its spins or more, or if two vehicles do, each with
  a score that reaches the threshold of pseudo-labels in the mean of its spins, 0 in those without the box. Vehicles run
  the same network in the same street, so that their false detections are correlated: two scores below the threshold do
  not add up to a label.
- A box of which one vehicle alone is sure is ignored in the loss: it is not unlearned, and no network confirms itself.
- A box that only vehicles report is dropped where road sensors observed free ground, or have another box.
- An anchor is a negative only where a road sensor observed free ground.

The map corrects headings and classes by the direction of lanes and the place of crossings. A car on a lane follows its
direction within a few degrees, so that the lane is one more measurement of its heading, joined by inverse variance.
The returns hardly distinguish front and back of a car, and the lane decides. A slow road user on a sidewalk or crossing
is a pedestrian, a fast one on a lane a cyclist; detectors confuse the two.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import KDTree
from shapely import STRtree
from shapely.geometry import Polygon

from flcav.arrays import Array, Ints, Mask
from flcav.config import Config
from flcav.fusion.average import (
    YAW,
    Navigation,
    RoadAverage,
    Sighting,
    add_pose_variance,
    average_boxes,
    report_boxes,
    variance_of,
)
from flcav.fusion.labels import cell_centers
from flcav.fusion.pose_graph import correct_poses
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, inverse, points_in_boxes, spread_over_footprints, transform_points, wrap_angle
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.modalities import read_cloud
from flcav.perception.objects.samples import Sample, crop_to_range, move_sample
from flcav.perception.objects.truth import detection_labels, is_lookalike, network_from_lidar
from flcav.sensors.frame import Frame
from flcav.world.map.layers import MapLane, MapLayers

STEP_M = 1.0  # between two points of a lane's centre line
LANE_RAD = np.radians(4.0)  # standard deviation of a car's heading about its lane's
ALONG_RAD = np.radians(30.0)  # a car turned by more from every lane follows none: it turns, or is parked
WALKING_MPS = 2.5  # fastest pedestrian
CARS = ("car", "van", "Car")
PEDESTRIAN, CYCLIST = ("pedestrian", "Pedestrian"), ("bicycle", "Cyclist")


@dataclass(frozen=True)
class MapContext:
    """The parts of a town's map by which labels are corrected."""

    points: KDTree  # (Q, 2) points of the centre lines of driving lanes [m], world frame
    yaw: Array  # (Q,) direction of driving at each point [rad]
    half_width_m: Array  # (Q,) of the lane
    walked: STRtree  # sidewalks and crossings


def build_context(layers: MapLayers) -> MapContext:
    """Return the context of a lane-level map; raises ValueError where it has no driving lane."""
    parts = [_sample(lane) for lane in layers.lanes if lane.kind == "driving" and len(lane.centre_line) > 1]
    if not parts:
        raise ValueError("the map has no driving lane")
    rows = np.concatenate(parts)
    areas = [Polygon(outline) for outline in (*layers.sidewalks, *(crossing.outline for crossing in layers.crossings))]
    return MapContext(KDTree(rows[:, :2]), rows[:, 2], rows[:, 3], STRtree(areas))


def snap_to_map(boxes: Boxes, velocity: Array, context: MapContext) -> Boxes:
    """Return the boxes (N,), world frame, with headings of cars and classes of vulnerable road users by the map.

    velocity: (N, 2) [m/s], world frame. Of several lanes at a place, as on a junction, the one nearest to the box's
    axis counts.
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
        # Inverse-variance mean of the heading and the lane's direction, modulo half a turn: the lane sets which way.
        lane = context.yaw[near[axis.argmin()]]
        deviation = (yaw[row] - lane + np.pi / 2) % np.pi - np.pi / 2
        share = LANE_RAD**2 / (LANE_RAD**2 + variance[row, YAW])
        yaw[row] = wrap_angle(lane + share * deviation)
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
    """Return points (Q, 4) of a lane's centre line: x, y [m], direction [rad], half the width [m]."""
    steps = np.diff(lane.centre_line, axis=0)
    lengths = np.hypot(*steps.T)
    counts = np.maximum(np.ceil(lengths / STEP_M).astype(int), 1)
    number = np.repeat(np.arange(len(steps)), counts)
    share = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[number]
    xy = lane.centre_line[:-1][number] + share[:, None] * steps[number]
    yaw = np.arctan2(steps[:, 1], steps[:, 0])[number]
    return np.column_stack((xy, yaw, np.full(len(xy), lane.width_m / 2)))


TOLD = 0.1  # lowest score of a detection that a vehicle reports
FREE = 0.5  # a box of vehicles alone is dropped where road sensors saw more than this share of its footprint as free
PARTS = (8, 4)  # points along and across a footprint by which that share is estimated
RETURNS_M = 0.3  # margin around a box within which returns are the object's, since poses have errors


class Distillation(Config):
    """Settings of federated distillation: terms of the loss, and what is averaged."""

    terms: tuple[Literal["regression", "contrastive"], ...] = Field(
        default=("regression", "contrastive"), min_length=1
    )  # of the loss, beside classification
    contrastive_weight: float = Field(default=0.1, gt=0, le=100)  # of the contrastive term
    temperature: float = Field(default=0.1, ge=0.01, le=10)  # of the contrastive term
    window_s: float = Field(default=0.5, ge=0, le=1)  # before and after a frame, of what is averaged; 0: its spin alone
    map_context: bool = True  # whether headings and classes of the average are snapped to the map, where there is one
    pose_graph: bool = False  # whether a pose graph corrects vehicles' poses and clocks: needs the extra `fusion`


@dataclass(frozen=True)
class Guidance:
    """Message of the edge server on one frame of a vehicle: the road average, in the vehicle's frame."""

    boxes: Boxes  # (K,) label = detection class, or the actor category of a lookalike; with scores and variances
    confirmed: Mask  # (K,) whether a road sensor has the box, or two vehicles are sure of it; others are ignored
    world_from_agent: Array  # (4, 4) [m] the vehicle's pose as the edge server estimates it

    def message(self) -> bytes:
        """Return the message to the vehicle; boxes in single precision."""
        return pack_arrays({"pose": self.world_from_agent, "confirmed": self.confirmed, **_pack_boxes(self.boxes)})

    @classmethod
    def from_message(cls, message: bytes) -> "Guidance":
        """Return the guidance in a message: the inverse of `message` up to single precision."""
        arrays = unpack_arrays(message)
        return cls(_unpack_boxes(arrays), arrays["confirmed"], arrays["pose"])


def pack_sighting(seen: Sighting) -> bytes:
    """Return a vehicle's sighting as its message to the edge server: time, pose and its accuracy, boxes, posts."""
    known = seen.navigation
    assert known is not None  # vehicles alone send messages: road sensors are wired
    about = {"time_s": np.array(seen.time_s), "accuracy": np.array((known.position_m, known.heading_rad))}
    posts = seen.posts.astype(np.float32)
    return pack_arrays({**about, "pose": seen.world_from_agent, "posts": posts, **_pack_boxes(seen.boxes)})


def unpack_sighting(agent: str, message: bytes) -> Sighting:
    """Return the sighting in a message of `agent`: the inverse of `pack_sighting` up to single precision."""
    arrays = unpack_arrays(message)
    posts, known = arrays["posts"].astype(np.float64), Navigation(*arrays["accuracy"].tolist())
    return Sighting(agent, float(arrays["time_s"]), arrays["pose"], _unpack_boxes(arrays), posts, known)


def _pack_boxes(boxes: Boxes) -> dict[str, NDArray]:
    score = np.ones(len(boxes)) if boxes.score is None else boxes.score
    rows = np.column_stack((boxes.array(), score, variance_of(boxes))).astype(np.float32)
    return {"boxes": rows, "label": from_names(boxes.label.tolist())}


def _unpack_boxes(arrays: Mapping[str, NDArray]) -> Boxes:
    rows = arrays["boxes"].astype(np.float64)
    return replace(Boxes.from_array(rows[:, :7], to_names(arrays["label"]), rows[:, 7]), variance=rows[:, 8:])


def average_spin(
    sightings: Sequence[Sighting],
    views: Sequence[RoadView],
    config: SecondConfig,
    threshold: float,
    posts: Array | None = None,
    context: MapContext | None = None,
    around: Sequence[Sighting] = (),
) -> list[Guidance]:
    """Return the edge server's guidance of each vehicle for a spin, in the order of the vehicles among the sightings.

    sightings: of vehicles, and of road sensors with actor categories as labels; views: of the road sensors. posts:
    (P, 2) feet of the posts on the map [m], by which a pose graph corrects poses and clocks; None: no correction.
    context: map by which headings and classes are corrected; None: no correction. around: sightings of other spins in
    the window, before and after, averaged with those of this one; without any all speeds are 0.
    """
    reported = [
        _classify(sighting, config) if sighting.navigation is None else sighting for sighting in (*sightings, *around)
    ]
    times_s = [sighting.time_s for sighting in sightings]
    surveyed_s = [sighting.time_s for sighting in sightings if sighting.navigation is None]
    at_s = float(np.median(surveyed_s or times_s or [0.0]))
    if posts is not None:
        reported = correct_poses(reported, posts, at_s)
    average = average_boxes([report_boxes(sighting) for sighting in reported], at_s)
    boxes = average.boxes if context is None else snap_to_map(average.boxes, average.velocity, context)
    road, sure = _count_votes(reported, average, threshold)
    kept = select_labels(boxes, road, views, threshold)
    confirmed = (road | (sure > 1))[kept]
    # Every vehicle gets the objects at the time of its own frame.
    vehicles = [sighting for sighting in reported[: len(sightings)] if sighting.navigation is not None]
    moved = [average.velocity[kept] * (vehicle.time_s - at_s) for vehicle in vehicles]
    return [place_in(_shift(boxes[kept], by), confirmed, vehicle) for vehicle, by in zip(vehicles, moved, strict=True)]


def _count_votes(reported: Sequence[Sighting], average: RoadAverage, threshold: float) -> tuple[Mask, Ints]:
    """Return (K,) whether a road sensor has each object, and (K,) the number of vehicles sure of it, over a window."""
    count = len(average.boxes)
    road = np.zeros(count, dtype=bool)
    sure = np.zeros(count, dtype=np.int64)
    for agent in {sighting.agent for sighting in reported}:
        of_agent = [(one, member) for one, member in zip(reported, average.member, strict=True) if one.agent == agent]
        seen = np.zeros(count)
        score = np.zeros(count)
        for sighting, member in of_agent:  # an object has at most one box of a sighting
            seen[member] += 1
            score[member] += 1.0 if sighting.boxes.score is None else sighting.boxes.score
        if of_agent[0][0].navigation is None:
            road |= (seen > 0) & (2 * seen >= len(of_agent))
        else:
            sure += (seen > 0) & (score / len(of_agent) >= threshold)
    return road, sure


def _shift(boxes: Boxes, xy_m: Array) -> Boxes:
    """Return boxes (N,) moved by `xy_m` (N, 2) along x and y [m]."""
    return replace(boxes, center=boxes.center + np.column_stack((xy_m, np.zeros(len(boxes)))))


def _classify(seen: Sighting, config: SecondConfig) -> Sighting:
    """Return a road sensor's sighting with detection classes instead of actor categories; lookalikes keep theirs."""
    category = seen.boxes.label
    named = detection_labels(category, config.classes)
    lookalike = is_lookalike(category, config.classes)
    label = np.where(lookalike, category, named)
    return replace(seen, boxes=replace(seen.boxes, label=label)[label != ""])


def select_labels(boxes: Boxes, road: Mask, views: Sequence[RoadView], threshold: float) -> Mask:
    """Return (N,) which boxes of an average the vehicles get; `road` (N,): whether a road sensor has the box."""
    assert boxes.score is not None
    seen = boxes[road]
    near = np.linalg.norm(boxes.center[:, None, :2] - seen.center[None, :, :2], axis=2) < seen.size[None, :, 0] / 2
    contradicted = near.any(axis=1) | (share_of_free_ground(boxes, views) > FREE)
    return road | ((boxes.score >= threshold) & ~contradicted)


def share_of_free_ground(boxes: Boxes, views: Sequence[RoadView]) -> Array:
    """Return (N,) the share of each box's footprint, world frame, that road sensors observed as free ground."""
    xy = spread_over_footprints(boxes, *PARTS)
    free = np.zeros(xy.shape[:2], dtype=bool)
    for view in views:
        free |= view.at(view.ground, xy.reshape(-1, 2)).reshape(free.shape)
    return free.mean(axis=1)


def place_in(boxes: Boxes, confirmed: Mask, seen: Sighting) -> Guidance:
    """Return boxes, world frame, as guidance of a vehicle: in its frame, with the variance of its pose added."""
    placed = add_pose_variance(boxes, seen).transform(inverse(seen.world_from_agent))
    return Guidance(placed, confirmed, seen.world_from_agent)


def distil_sample(
    frame: Frame, own: Boxes, guidance: Guidance, views: Sequence[RoadView], config: SecondConfig, lidar: str
) -> Sample:
    """Return a vehicle's frame with the labels of federated distillation; network's frame.

    own: the vehicle's detections, LiDAR frame; views: of the road sensors at the spin. Targets are the confirmed boxes
    with returns of the vehicle; others, and lookalikes, are ignored in the loss. `free` holds the cell centres that a
    road sensor observed as free ground, by the vehicle's estimated pose and assumed mount.
    """
    mount = frame.assumed.agent_from_sensor[lidar]
    points = crop_to_range(read_cloud(frame, config, lidar), config)
    boxes = guidance.boxes.transform(inverse(mount))
    of_classes = np.isin(boxes.label, config.classes)
    targets = of_classes & guidance.confirmed & points_in_boxes(points, boxes, margin_m=RETURNS_M).any(axis=1)
    cells = cell_centers(config)
    below = np.column_stack((cells, np.full(len(cells), -mount[2, 3])))
    world = transform_points(guidance.world_from_agent @ mount, below)[:, :2]
    free = np.zeros(len(cells), dtype=bool)
    for view in views:
        free |= view.at(view.ground, world)
    ignored = replace(boxes[~targets], score=None, variance=None)
    sample = Sample(points, boxes[targets], ignored, cells[free].astype(np.float32), own=own)
    return move_sample(sample, network_from_lidar(frame, config, lidar))
