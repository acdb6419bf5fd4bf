"""Data augmentation of LiDAR sweeps: global transforms, object scaling, dropped returns, ground-truth sampling.

Global mirroring, rotation and scaling, and ground-truth sampling are those of SECOND (Yan et al. 2018, sec. 3.2.1). The
others vary what differs between LiDARs, cars and countries: sizes of objects (random object scaling of Yang et al.,
"ST3D", CVPR 2021), pose of the sensor, number of beams, lost returns, paint of objects, field of view. Boxes drawn by
annotators have a margin: they begin before the first return, and leave out mirrors.

Ground-truth sampling pastes an object with its returns at the position where it was recorded, so that their density
fits its distance. It is skipped where its footprint overlaps another; returns of the scene inside its box are removed.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from flcav.arrays import Array, Array32, Ints, Mask
from flcav.geometry import Boxes, concatenate, heading_vectors, points_in_boxes
from flcav.perception.objects.config import Augmentation, SecondConfig
from flcav.perception.objects.modalities import blind
from flcav.perception.objects.samples import Sample, map_sample
from flcav.perception.objects.truth import MIN_RETURNS, in_range
from flcav.perception.ops.boxes import iou

DENSE = 20_000  # returns ahead of a LiDAR of some 40 beams or more
BETWEEN_DEG, BAND_DEG = (0.8, 2.6), (0.15, 0.35)  # least and most of the angle between bands that are kept, of a band
VIEW = (0.845, 0.28, 0.24)  # tangents of a camera's field of view, sideways, down and up: KITTI's left colour camera


def augment(sample: Sample, how: Augmentation, rng: np.random.Generator) -> Sample:
    """Return the sample augmented by random amounts drawn from `rng`, within the limits of `how`.

    The order is: the second modality is left out; objects lose returns; a dense sweep is thinned; cars are resized, and
    boxes get their margin; the whole sweep is mirrored, rotated and scaled; shifted; tilted and lifted; returns are
    dropped; the sweep is cut to a camera's field of view.
    """
    if how.blind and rng.random() < how.blind:
        sample = replace(sample, points=blind(sample.points))
    if how.fade:
        sample = fade_objects(sample, rng.uniform(0, how.fade, len(sample.boxes)), rng)
    if how.thin and rng.random() < how.thin and len(sample.points) > DENSE:
        sample = keep_returns(sample, in_bands(sample.points, rng.uniform(*BETWEEN_DEG), rng.uniform(*BAND_DEG), rng))
    mirror = -1.0 if how.flip and rng.random() < 0.5 else 1.0
    turn = rng.uniform(-how.turn_rad, how.turn_rad)
    scale = rng.uniform(1 - how.scale, 1 + how.scale)
    low, high = np.transpose(how.resize)
    if (low != 1).any() or (high != 1).any():
        factor = rng.uniform(low, high, size=(len(sample.boxes), 3))
        changed = (sample.boxes.label == "Car") & (rng.random(len(factor)) < how.resized)
        sample = resize_objects(sample, np.where(changed[:, None], factor, 1.0))
    for name, *margin_m in how.margin_m:
        sample = replace(sample, boxes=add_margin(sample.boxes, name, margin_m))
    sample = transform_sample(sample, mirror, turn, scale)
    if how.shift_m:
        sample = shift_sample(sample, rng.uniform(-how.shift_m, how.shift_m, size=2))
    if how.tilt_rad or how.lift_m:
        slope = np.tan(rng.uniform(0, how.tilt_rad)) * heading_vectors(rng.uniform(0, 2 * np.pi))
        sample = tilt_sample(sample, slope, rng.uniform(-how.lift_m, how.lift_m))
    kept = np.ones(len(sample.points), dtype=bool)
    if how.drop:
        kept &= rng.random(len(kept)) >= rng.uniform(0, how.drop)
    if how.view and rng.random() < how.view:
        kept &= in_view(sample.points)
    return sample if kept.all() else keep_returns(sample, kept)


def transform_sample(sample: Sample, mirror: float, turn_rad: float, scale: float) -> Sample:
    """Return the sample with y times `mirror` (1 or -1), then rotated counter-clockwise by `turn_rad`, then scaled."""
    cos, sin = heading_vectors(turn_rad) * scale
    plane = np.array([[cos, sin], [-mirror * sin, mirror * cos]])  # right factor of rows (x, y)
    points = sample.points.copy()
    points[:, :2] = points[:, :2] @ plane.astype(np.float32)
    points[:, 2] *= np.float32(scale)

    def moved(boxes: Boxes) -> Boxes:
        center = np.concatenate((boxes.center[:, :2] @ plane, boxes.center[:, 2:] * scale), 1)
        variance = boxes.variance
        if variance is not None:
            parts = variance[:, :2] @ np.square(plane), variance[:, 2:6] * scale**2, variance[:, 6:]
            variance = np.concatenate(parts, axis=1)
        yaw = boxes.yaw * mirror + turn_rad
        return replace(boxes, center=center, size=boxes.size * scale, yaw=yaw, variance=variance)

    free = None if sample.free is None else (sample.free @ plane).astype(np.float32)
    return map_sample(sample, points, moved, free)


def resize_objects(sample: Sample, factor: Array) -> Sample:
    """Return the sample with box n and the returns inside it scaled by factor[n] (N, 3): length, width and height.

    The centre of an object's bottom face stays in place.
    """
    boxes = sample.boxes
    points = sample.points.copy()
    foot = boxes.center - boxes.size * (0, 0, 0.5)
    changed = np.flatnonzero((factor != 1).any(1))
    for row, inside in zip(changed, points_in_boxes(sample.points, boxes[changed]), strict=True):
        along = heading_vectors(boxes.yaw[row])
        frame = np.array([[*along, 0], [-along[1], along[0], 0], [0, 0, 1]])  # rows: axes of the box
        stretch = frame.T @ np.diag(factor[row]) @ frame
        points[inside, :3] = (sample.points[inside, :3] - foot[row]) @ stretch + foot[row]
    size = boxes.size * factor
    return replace(sample, points=points, boxes=replace(boxes, center=foot + size * (0, 0, 0.5), size=size))


def add_margin(boxes: Boxes, name: str, margin_m: Sequence[float]) -> Boxes:
    """Return the boxes, those of a class longer, wider and higher by a margin [m]; their bottoms stay in place."""
    more = np.where((boxes.label == name)[:, None], margin_m, 0.0)
    return replace(boxes, center=boxes.center + more * (0, 0, 0.5), size=boxes.size + more)


def shift_sample(sample: Sample, by_m: Array) -> Sample:
    """Return the sample shifted in x, y by `by_m` (2,) [m]: the distance of parked cars from the lane varies."""
    points = sample.points.copy()
    points[:, :2] += by_m.astype(np.float32)
    free = None if sample.free is None else sample.free + by_m.astype(np.float32)
    return map_sample(sample, points, lambda boxes: replace(boxes, center=boxes.center + np.append(by_m, 0)), free)


def tilt_sample(sample: Sample, slope: Array, lift_m: float) -> Sample:
    """Return the sample with z raised by lift_m + slope . (x, y), slope (2,): a small tilt that keeps boxes upright."""
    points = sample.points.copy()
    points[:, 2] += (points[:, :2] @ slope + lift_m).astype(np.float32)

    def moved(boxes: Boxes) -> Boxes:
        rise = boxes.center[:, :2] @ slope + lift_m
        return replace(boxes, center=boxes.center + rise[:, None] * (0, 0, 1))

    return map_sample(sample, points, moved, sample.free)


def in_view(points: Array32) -> Mask:
    """Return the mask (N,) of points (N, >= 3), LiDAR frame, in the field of view of a forward camera at the sensor."""
    side, down, up = VIEW
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    return (x > 0) & (np.abs(y) < side * x) & (z > -down * x) & (z < up * x)


def fade_objects(sample: Sample, lost: Array, rng: np.random.Generator) -> Sample:
    """Return the sample without a share lost[n] of the returns inside box n, drawn by `rng`, as of dark paint."""
    share = (points_in_boxes(sample.points, sample.boxes) * lost[:, None]).max(axis=0, initial=0.0)
    return keep_returns(sample, rng.random(len(sample.points)) >= share)


def in_bands(points: Array32, between_deg: float, band_deg: float, rng: np.random.Generator) -> Mask:
    """Return the mask (N,) of points (N, >= 3) in bands of elevation, as of a LiDAR with a beam in each band.

    The bands are `band_deg` high and begin `between_deg` apart; `rng` draws the elevation of the first.
    """
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    return np.mod(elevation - rng.uniform(0, between_deg), between_deg) < band_deg


def keep_returns(sample: Sample, kept: Mask) -> Sample:
    """Return the sample with only the returns in the mask `kept` (N,).

    Objects left with fewer than `MIN_RETURNS` returns are ignored; those left with none are removed.
    """
    points = sample.points[kept]
    returns = _count_returns(points, sample.boxes)
    enough = returns >= MIN_RETURNS
    exact = None if sample.exact is None else sample.exact[enough]
    ignore = concatenate(
        [sample.boxes[(returns > 0) & ~enough], sample.ignore[_count_returns(points, sample.ignore) > 0]]
    )
    return replace(sample, points=points, boxes=sample.boxes[enough], ignore=ignore, exact=exact)


def _count_returns(points: Array32, boxes: Boxes) -> Ints:
    return points_in_boxes(points, boxes).sum(1)


@dataclass(frozen=True)
class Cutouts:
    """Ground-truth database: objects with the returns inside their boxes, LiDAR frame."""

    boxes: Boxes  # (B,) label = detection class
    points: tuple[Array32, ...]  # per box (N, 4) x, y, z [m], intensity [0, 1]
    swept: Ints  # (B,) returns of the sweep that the object is from


def cut_out_objects(samples: Iterable[Sample], config: SecondConfig) -> Cutouts:
    """Return the ground-truth database of samples: objects in range, of known pose, with enough returns."""
    boxes, points, swept = [Boxes.empty()], [], []
    for sample in samples:
        known = np.ones(len(sample.boxes), dtype=bool) if sample.exact is None else sample.exact
        known_boxes = sample.boxes[known & in_range(sample.boxes, config)]
        inside = points_in_boxes(sample.points, known_boxes)
        enough = inside.sum(1) >= MIN_RETURNS
        boxes.append(known_boxes[enough])
        points += [sample.points[row] for row in inside[enough]]
        swept += [len(sample.points)] * int(enough.sum())
    return Cutouts(concatenate(boxes), tuple(points), np.array(swept, dtype=np.int64))


def paste_objects(
    sample: Sample, cutouts: Cutouts, most: int, rng: np.random.Generator, alike: float | None = None
) -> Sample:
    """Return the sample with objects of the ground-truth database pasted in, up to `most` of each class in total.

    Candidates are drawn by `rng` without replacement; those whose footprints overlap another object's are left out, and
    so are those of sweeps with more than `alike` times more or fewer returns than the sample (None: of no sweep).
    """
    ratio = cutouts.swept / max(len(sample.points), 1)
    fits = np.ones(len(ratio), dtype=bool) if alike is None else (ratio <= alike) & (ratio * alike >= 1)
    drawn = []
    for label in np.unique(cutouts.boxes.label):
        known = np.flatnonzero((cutouts.boxes.label == label) & fits)
        missing = max(most - np.count_nonzero(sample.boxes.label == label), 0)
        drawn.append(rng.permutation(known)[:missing])
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *drawn])
    taken = numbers[select_free(cutouts.boxes[numbers], concatenate([sample.boxes, sample.ignore]))]
    added = cutouts.boxes[taken]
    kept = sample.points[~points_in_boxes(sample.points, added).any(0)]
    exact = None if sample.exact is None else np.append(sample.exact, np.ones(len(added), dtype=bool))
    cloud = np.concatenate((kept, *(cutouts.points[number] for number in taken)))
    return replace(sample, points=cloud, boxes=concatenate([sample.boxes, added]), exact=exact)


def select_free(candidates: Boxes, there: Boxes) -> Ints:
    """Return the indices of candidates, chosen greedily in order, that overlap no other box in bird's-eye view.

    They overlap neither the boxes `there` nor one another.
    """
    everything = torch.from_numpy(np.concatenate((there.array(), candidates.array())))
    meets = (iou(torch.from_numpy(candidates.array()), everything, "bev") > 0).numpy()
    blocked = np.asarray(meets[:, : len(there)].any(axis=1))
    taken: list[int] = []
    for number in range(len(candidates)):
        if not blocked[number]:
            taken.append(number)
            blocked |= meets[:, len(there) + number]
    return np.array(taken, dtype=np.int64)
