"""Annotations from CARLA's actors: boxes and motion from its snapshots, occlusion from its semantic sensors.

Occlusion is the share of the rays that meet an actor's box and end before it. Rays that pass through the box without
hitting the body do not count as occluded, so that an unobstructed actor has 0. CARLA's boxes are somewhat larger than
its bodies, and so are the rectangles in images, which are those of the boxes.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from flcav.carla.recording.sensors import SemanticSweep
from flcav.carla.recording.traffic import State
from flcav.geometry import Array, Boxes, count_points_in_boxes, inverse, points_in_boxes, transform_points
from flcav.sensors.frame import SEMANTICS, Annotations, SignViews, Views
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.sensors.views import clip_boxes, find_actor_regions, outline_boxes

SLACK_M = 0.1  # by which a surface may protrude from its box
SAME_M, SIGMAS = 0.02, 4.0  # largest distance of two LiDARs' points of the same ray, plus standard deviations of noise
VEHICLES = tuple(SEMANTICS[name] for name in ("rider", "car", "truck", "bus", "motorcycle", "bicycle"))
PEOPLE = (SEMANTICS["pedestrian"],)


class LabelledSweep(NamedTuple):
    """The sweep of a LiDAR, and that of the semantic LiDAR with the same pose."""

    lidar: Lidar
    world_from_sensor: Array  # (4, 4) [m]
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity, sensor frame
    met: SemanticSweep  # returns of the semantic LiDAR


class CameraSight(NamedTuple):
    """The depth and semantic images of a camera, with its pose."""

    lens: Lens
    world_from_camera: Array  # (4, 4) of the optical frame [m]
    depth_m: NDArray[np.float32]  # (H, W) along the optical axis [m]
    semantic: NDArray[np.uint8]  # (H, W) class


def annotate_bodies(
    state: State,
    own: int | None,
    within: NDArray[np.bool_],
    sweeps: Mapping[str, LabelledSweep],
    sights: Mapping[str, CameraSight],
) -> tuple[Annotations, dict[str, NDArray[np.uint16]]]:
    """Return the annotations of M bodies, and the instance images (H, W) of the cameras, by name.

    A body is annotated if it is `within` (N,) range or visible in a camera; the carrier, CARLA's actor `own`, is not.
    """
    count = len(state.bodies)
    instances = {name: _find_instances(state.boxes, sight) for name, sight in sights.items()}
    shown = [find_actor_regions(image, count).pixels > 0 for image in instances.values()]
    labelled = np.logical_or.reduce([within, *shown]) if count else within
    labelled &= np.array([own is None or body.number != own for body in state.bodies], bool)
    rows = np.flatnonzero(labelled)
    order = np.zeros(count + 1, np.uint16)
    order[rows + 1] = np.arange(1, len(rows) + 1)
    images = {name: order[image] for name, image in instances.items()}
    boxes = state.boxes[rows]
    bodies = [state.bodies[row] for row in rows]
    numbers = np.array([body.number for body in bodies], np.int64)
    points = {name: _count_returns(boxes, numbers, sweep) for name, sweep in sweeps.items()}
    annotations = Annotations(
        track=np.array([body.track for body in bodies], np.str_).reshape(len(rows)),
        boxes=boxes,
        velocity=state.velocity[rows],
        acceleration=state.acceleration[rows],
        returns=sum(points.values(), np.zeros(len(rows), np.int64)),
        occlusion=_hide_from_lidars(boxes, numbers, list(sweeps.values())),
        points=points,
        views={name: _view(boxes, sight, images[name]) for name, sight in sights.items()},
        signs={name: SignViews.none() for name in sights},
    )
    return annotations, images


def enter_box(origin: Array, directions: Array, half: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return whether rays meet a box (R,), and the distances (R,) [m] at which they enter it, by the slab method.

    In the box frame: `origin` (3,) [m] of all rays and unit `directions` (R, 3); `half` (3,) are the half sides [m]
    (Kay and Kajiya, 1986).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - origin) / directions, (half - origin) / directions
    near, far = np.fmin(first, second).max(axis=1), np.fmax(first, second).min(axis=1)
    return (near <= far) & (far > 0), np.maximum(near, 0.0)


def _count_returns(boxes: Boxes, numbers: NDArray[np.int64], sweep: LabelledSweep) -> NDArray[np.int64]:
    """Count (M,) a LiDAR's points on bodies: a point belongs to the actor of the nearest point of the semantic LiDAR.

    A parked vehicle is not an actor of CARLA: points of a vehicle class in its box count.
    """
    if not len(sweep.points) or not len(sweep.met.points):
        return np.zeros(len(boxes), np.int64)
    away, nearest = (np.asarray(found) for found in KDTree(sweep.met.points).query(sweep.points[:, :3]))
    same = away <= SAME_M + SIGMAS * sweep.lidar.noise_m
    actor = sweep.met.actor[nearest[same]]
    vehicle = np.isin(sweep.met.tag[nearest[same]], VEHICLES)
    counts = np.array([np.count_nonzero(actor == number) for number in numbers], np.int64)
    parked = np.flatnonzero(numbers == 0)
    ours = sweep.points[same][vehicle & (actor == 0)]
    counts[parked] = count_points_in_boxes(ours, boxes[parked], sweep.world_from_sensor)
    return counts


def _hide_from_lidars(boxes: Boxes, numbers: NDArray[np.int64], sweeps: list[LabelledSweep]) -> Array:
    """Return the share (M,) of the rays towards boxes that end before them, over all LiDARs; 1 where none arrives."""
    visible, hidden, rays = np.zeros((3, len(boxes)), np.int64)
    for sweep in sweeps:
        pattern = build_ray_pattern(sweep.lidar).astype(np.float64)
        distance = np.linalg.norm(sweep.met.points, axis=1)
        lines = sweep.met.points.astype(np.float64) / np.maximum(distance, 1e-6)[:, None]
        for row in range(len(boxes)):
            box_from_sensor = inverse(boxes.pose(row)) @ sweep.world_from_sensor
            turn, origin, half = box_from_sensor[:3, :3], box_from_sensor[:3, 3], boxes.size[row] / 2
            towards = _towards(pattern, turn, origin, half)
            rays[row] += np.count_nonzero(enter_box(origin, pattern[towards] @ turn.T, half)[0])
            towards = _towards(lines, turn, origin, half)
            meets, enters = enter_box(origin, lines[towards] @ turn.T, half)
            number = sweep.met.actor[towards]
            if numbers[row]:
                seen = number == numbers[row]
                visible[row] += np.count_nonzero(sweep.met.actor == numbers[row])
            else:  # parked: part of the town, identified by the points in its box
                ends = origin + (lines[towards] * distance[towards, None]) @ turn.T
                seen = (np.abs(ends) <= half + SLACK_M).all(axis=1) & np.isin(sweep.met.tag[towards], VEHICLES)
                visible[row] += np.count_nonzero(seen)
            hidden[row] += np.count_nonzero(meets & ~seen & (distance[towards] < enters - SLACK_M))
    return np.where(visible > 0, np.clip(hidden / np.maximum(rays, 1), 0.0, 1.0), 1.0)


def _towards(lines: Array, turn: Array, origin: Array, half: Array) -> NDArray[np.int64]:
    """Return the indices of rays (R, 3), sensor frame, that may meet a box: in the cone of its bounding sphere."""
    away, radius = float(np.linalg.norm(origin)), float(np.linalg.norm(half))
    if away <= radius:
        return np.arange(len(lines))
    middle = turn.T @ (-origin / away)
    return np.flatnonzero(lines @ middle >= np.sqrt(1 - (radius / away) ** 2))


def _find_instances(boxes: Boxes, sight: CameraSight) -> NDArray[np.int32]:
    """Return the instance image (H, W): row + 1 of the nearest box of its class around the pixel's point, or 0."""
    lens = sight.lens
    instance = np.zeros(sight.depth_m.shape, np.int32)
    outlines, _ = outline_boxes(boxes.corners(), lens, sight.world_from_camera)
    rectangles = clip_boxes(outlines, lens)
    known = np.flatnonzero(~np.isnan(rectangles).any(axis=1))
    rays = _scaled_rays(lens)
    away = np.linalg.norm(boxes.center - sight.world_from_camera[:3, 3], axis=1)
    for row in known[np.argsort(-away[known])].tolist():  # the nearest last
        window = _window(rectangles[row])
        depth = sight.depth_m[window]
        classes = PEOPLE if boxes.label[row] == "pedestrian" else VEHICLES
        mask = np.isfinite(depth) & np.isin(sight.semantic[window], classes)
        if not mask.any():
            continue
        points = transform_points(sight.world_from_camera, (rays[window][mask] * depth[mask][:, None]))
        mask[mask] = points_in_boxes(points, boxes[[row]], SLACK_M)[0]
        instance[window][mask] = row + 1
    return instance


def _view(boxes: Boxes, sight: CameraSight, instance: NDArray[np.uint16]) -> Views:
    lens = sight.lens
    outlines, truncation = outline_boxes(boxes.corners(), lens, sight.world_from_camera)
    regions = find_actor_regions(instance.astype(np.int32), len(boxes))
    occlusion = np.ones(len(boxes))
    rays, rectangles = _scaled_rays(lens), clip_boxes(outlines, lens)
    for row in np.flatnonzero(regions.pixels):
        window = _window(rectangles[row])
        lines = rays[window].reshape(-1, 3)
        length = np.linalg.norm(lines, axis=1)
        box_from_camera = inverse(boxes.pose(int(row))) @ sight.world_from_camera
        turned = (lines / length[:, None]) @ box_from_camera[:3, :3].T
        meets, enters = enter_box(box_from_camera[:3, 3], turned, boxes.size[row] / 2)
        before = sight.depth_m[window].reshape(-1) * length < enters - SLACK_M
        before &= instance[window].reshape(-1) != row + 1
        occlusion[row] = np.count_nonzero(meets & before) / max(np.count_nonzero(meets), 1)
    return Views(outlines, regions.box, regions.pixels, truncation, occlusion)


def _scaled_rays(lens: Lens) -> Array:
    """Return the rays (H, W, 3) of the pixels, optical frame, scaled to unit depth."""
    rays = compute_pixel_rays(lens).reshape(lens.height, lens.width, 3).astype(np.float64)
    return rays / rays[..., 2:]


def _window(rectangle: Array) -> tuple[slice, slice]:
    """Return the rows and columns of the pixels within a rectangle x1, y1, x2, y2 [px]."""
    x1, y1, x2, y2 = rectangle
    return slice(int(np.ceil(y1)), int(np.floor(y2)) + 1), slice(int(np.ceil(x1)), int(np.floor(x2)) + 1)
