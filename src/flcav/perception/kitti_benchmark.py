"""Evaluation by the rules of KITTI's object benchmark: easy, moderate and hard; AP|R40 in image, bird's eye and 3D.

Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving?", CVPR 2012, and `evaluate_object.cpp` of the benchmark's
development kit; 40 recall positions by Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV 2019.

An object counts at a level by the height of its rectangle in the image, its occlusion and truncation; an object that
does not is ignored, and so are objects of the similar class. Detections lower than the level's height are ignored. In
the image, detections in a DontCare region are ignored, too; such a region has no position in space.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch

from flcav.arrays import Array, Ints, Mask, Words
from flcav.config import InputError
from flcav.dataset.formats.kitti import KittiCalibration, KittiFolder, KittiFrame
from flcav.dataset.formats.kitti.files import is_drive
from flcav.dataset.formats.kitti.write import FRAMES
from flcav.dataset.formats.rig import LOOKED, RANGE_M, LidarRig
from flcav.dataset.layout import MANIFEST
from flcav.dataset.scene_checks import EmptyBoxes
from flcav.geometry import Boxes, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.machine.compiled import compiled
from flcav.perception.errors import THRESHOLD
from flcav.perception.images import kitti_view
from flcav.perception.metrics.detection import interval_words
from flcav.perception.metrics.operating_point import FoundAtDistance, describe_counts
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.evaluate import Score, count_objects, score_detections
from flcav.perception.objects.modalities import refuse_files
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import LOWEST_SCORE, detect_moved
from flcav.perception.objects.samples import describe_rig
from flcav.perception.objects.truth import FrameTruth, level_mount
from flcav.perception.ops.boxes import iou
from flcav.perception.task import Evaluated, KnownLidar
from flcav.sensors.views import BOX_EDGES, NEAR_M, clip_in_front
from flcav.storage.records import LEFT_OUT, Class

COUNTS, IGNORED, OTHER = 0, 1, -1  # state of an object or a detection for a class at a level
RECALLS = 41  # positions of recall; the first, 0, is left out of the mean
SIMILAR = {"Car": "Van", "Pedestrian": "Person_sitting"}


class Difficulty(NamedTuple):
    """Criteria of a level of difficulty: the objects that count at it."""

    height_px: float  # of the rectangle in the image: higher ones count
    occlusion: int  # at most: 0 fully visible, 1 partly and 2 largely occluded
    truncation: float  # at most


LEVELS: Mapping[str, Difficulty] = {
    "easy": Difficulty(40, 0, 0.15),
    "moderate": Difficulty(25, 1, 0.3),
    "hard": Difficulty(25, 2, 0.5),
}


@dataclass(frozen=True)
class ClassFrame:
    """The detections and objects of a frame for one class, level and kind of overlap."""

    score: Array  # (D,)
    detection: Ints  # (D,) COUNTS, IGNORED or OTHER
    label: Ints  # (G,) COUNTS, IGNORED or OTHER of the objects
    overlap: Array  # (D, G) IoU
    excused: Mask  # (D,) lies in a DontCare region


def label_states(
    name: str, labels: Words, height_px: Array, occlusion: Ints, truncation: Array, level: Difficulty
) -> Ints:
    """Return the state (G,) of a frame's objects for the class `name` at a level: COUNTS, IGNORED or OTHER."""
    hard = (occlusion > level.occlusion) | (truncation > level.truncation) | (height_px <= level.height_px)
    same = labels == name
    similar = labels == SIMILAR.get(name, "")
    return np.where(same & ~hard, COUNTS, np.where(same | similar, IGNORED, OTHER)).astype(np.int64)


def detection_states(name: str, labels: Words, height_px: Array, level: Difficulty) -> Ints:
    """Return the state (D,) of a frame's detections for the class `name` at a level: COUNTS, IGNORED or OTHER."""
    return np.where(height_px < level.height_px, IGNORED, np.where(labels == name, COUNTS, OTHER)).astype(np.int64)


def average_precision_r40(frames: Sequence[ClassFrame], limit: float) -> float | None:
    """Return the AP|R40 in [0, 1] of frames of one class, level and kind; None where no object counts.

    `limit` is the IoU above which a detection matches an object. At each score that reaches a further fortieth of
    recall, detections and objects are matched anew; precision is made non-increasing in recall, and its mean is taken.
    """
    targets = sum(int((frame.label == COUNTS).sum()) for frame in frames)
    if not targets:
        return None
    busy = [frame for frame in frames if len(frame.score)]
    reached = [_match(frame, limit, -np.inf, False)[2] for frame in busy]
    scores = np.concatenate(reached) if reached else np.zeros(0)
    precision = np.zeros(RECALLS)
    for place, threshold in enumerate(find_thresholds(scores, targets)):
        counts = [count_matches(frame, limit, threshold) for frame in busy]
        true, false = (sum(column) for column in zip(*counts, strict=True))
        precision[place] = true / max(true + false, 1)
    falling = np.maximum.accumulate(precision[::-1])[::-1]
    return float(falling[1:].mean())


def count_matches(frame: ClassFrame, limit: float, threshold: float) -> tuple[int, int]:
    """Return the numbers of true and false positives of a frame among detections that score at least `threshold`."""
    return _match(frame, limit, threshold, True)[:2]


def find_thresholds(scores: Array, targets: int) -> list[float]:
    """Return the scores, from the highest on, at which recall is nearest to each further fortieth, at most RECALLS.

    `scores` are those of the detections that match one of `targets` objects.
    """
    ordered = np.sort(scores)[::-1].tolist()
    thresholds: list[float] = []
    recall = 0.0
    for rank, score in enumerate(ordered, start=1):
        here = rank / targets
        last = rank == len(ordered)
        further = here if last else (rank + 1) / targets
        if further - recall < recall - here and not last:
            continue
        thresholds.append(score)
        recall += 1 / (RECALLS - 1)
    return thresholds[:RECALLS]


def _match(frame: ClassFrame, limit: float, threshold: float, counted: bool) -> tuple[int, int, Array]:
    """Return `_match_arrays` for a frame."""
    arrays = (frame.score, frame.detection, frame.label, frame.overlap, frame.excused)
    return _match_arrays(arrays, limit, threshold, counted)


@compiled
def _match_arrays(
    frame: tuple[Array, Ints, Ints, Array, Mask], limit: float, threshold: float, counted: bool
) -> tuple[int, int, Array]:
    """Return true positives, false positives, and the scores (T,) of the true ones, for scores from `threshold` on.

    Objects take detections in their order: with `counted` the one of highest overlap, preferring one that counts over
    an ignored one; otherwise, to find thresholds, the one of highest score.
    """
    score, detection, label, overlap, excused = frame
    taken = np.zeros(len(score), np.bool_)
    true = 0
    reached = np.zeros(len(label))
    for g in range(len(label)):
        if label[g] == OTHER:
            continue
        best, most, spare = -1, 0.0, False
        for d in range(len(score)):
            if detection[d] == OTHER or taken[d] or score[d] < threshold or overlap[d, g] <= limit:
                continue
            if not counted:
                if best < 0 or score[d] > score[best]:
                    best = d
            elif detection[d] == COUNTS and (best < 0 or spare or overlap[d, g] > most):
                best, most, spare = d, overlap[d, g], False
            elif detection[d] == IGNORED and best < 0:
                best = d
                spare = True
        if best < 0:
            continue
        taken[best] = True
        if label[g] == COUNTS and detection[best] == COUNTS:
            reached[true] = score[best]
            true += 1
    false = 0
    for d in range(len(score)):
        if detection[d] == COUNTS and not taken[d] and score[d] >= threshold and not excused[d]:
            false += 1
    return true, false, reached[:true]


BenchmarkKind = Literal["image", "bev", "3d"]  # rectangles in the image, footprints, boxes

LIMITS = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}  # IoU above which a detection matches an object
LOOSE = {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}  # OpenPCDet's, in addition, on the ground and in space
COMPARED: tuple[tuple[Mapping[str, float], BenchmarkKind], ...] = (
    (LIMITS, "image"),
    (LIMITS, "bev"),
    (LIMITS, "3d"),
    (LOOSE, "bev"),
    (LOOSE, "3d"),
)
NEUTRAL = {"Van": "Car", "Truck": "Car", "Tram": "Car", "Misc": "Car", "Person_sitting": "Pedestrian"}  # -> class
VALIDATION = "val"  # list of the frames to evaluate, where it exists


@dataclass(frozen=True)
class BenchmarkScore:
    """AP|R40 of a class by one kind of overlap, in [0, 1]; None where no object counts at a level."""

    label: Class
    kind: BenchmarkKind
    iou: float  # above which a detection matches an object
    easy: float | None
    moderate: float | None
    hard: float | None


@dataclass(frozen=True, kw_only=True)
class BenchmarkEvaluation(Evaluated):
    """Evaluation of an object detector on frames of KITTI by the rules of its benchmark."""

    frames: int
    split: str | None  # list of `ImageSets` that names the frames; None: all that have labels
    targets: Mapping[str, Mapping[str, int]]  # class -> level -> number of objects that count
    benchmark: tuple[BenchmarkScore, ...]  # class by class, at the benchmark's limit of IoU and at `LOOSE`
    false_positives: Mapping[str, int]  # class -> unmatched detections, in space at `LOOSE` and the level hard
    threshold: float  # lowest score of those detections
    bare: int  # frames without an image: a size is assumed
    bare_px: Annotated[tuple[str, ...] | None, LEFT_OUT] = None  # that size, "1242 x 375"; None where all have images
    labelled: Annotated[tuple[Score, ...] | None, LEFT_OUT] = None  # of all labelled objects, whatever their height
    counts: Annotated[tuple[FoundAtDistance, ...] | None, LEFT_OUT] = None  # of the same; None in earlier results

    @property
    def score(self) -> float:
        """Return the mean over classes of the moderate AP in 3D at the benchmark's limits, 0 where there is none."""
        known = [
            row.moderate
            for row in self.benchmark
            if row.kind == "3d" and row.iou == LIMITS[row.label] and row.moderate is not None
        ]
        return float(np.mean(known)) if known else 0.0

    def lines(self) -> list[str]:
        """Return a line on the frames and one for each class and kind."""
        which = f"of ImageSets/{self.split}.txt" if self.split else "with labels"
        lines = [f"{plural(self.frames, 'frame')} {which}, AP R40 as KITTI's benchmark counts it: easy, moderate, hard"]
        if self.bare:
            sizes = " or ".join(self.bare_px or ())
            lines.append(f"{self.bare} of them without an image, taken as {sizes} pixels")
        for row in self.benchmark:
            precisions = "  ".join("    -" if ap is None else f"{ap:.3f}" for ap in (row.easy, row.moderate, row.hard))
            counted = ", ".join(str(number) for number in self.targets[row.label].values())
            lines.append(f"{row.label:<11}{row.kind:>6} IoU {row.iou:<4g}  {precisions}  (objects: {counted})")
        for name, wrong in self.false_positives.items():
            where = f"in 3d at IoU {LOOSE[name]:g}, scores of {self.threshold:g} or more"
            lines.append(f"{name:<11}{wrong / self.frames:.2f} false positives a frame ({wrong}; {where})")
        if self.labelled is not None and self.counts is not None:
            lines.append("every labelled object in the image, AP R40 with its interval over frames:")
            for row in self.labelled:
                if row.ap is not None:
                    interval = interval_words(row.low, row.high)
                    lines.append(f"{row.label:<12}{row.kind:>4} IoU {row.iou:.1f}  AP {row.ap:.3f} {interval}")
            lines += describe_counts(self.counts)
        return lines


@dataclass(frozen=True)
class _Found:
    """Detections and objects of a frame, as the evaluation needs them: G objects, D detections."""

    boxes: Boxes  # (D,)
    rectangle: Array  # (D, 4) [px]
    frame: KittiFrame
    overlap: Mapping[BenchmarkKind, Array]  # (D, G) IoU
    unlabelled: Array  # (D,) share of the rectangle in a DontCare region


def is_kitti(path: Path) -> bool:
    """Return whether `path` is a folder in KITTI's layout rather than a dataset of flcav."""
    return (path / "training" / "velodyne").is_dir() or (is_drive(path) and not (path / MANIFEST).exists())


def compare_kitti_rig(path: Path, rig: LidarRig, config: SecondConfig, trained: KnownLidar) -> str:
    """Return how the LiDAR of the KITTI folder `path` differs from KITTI's and from that of the network's training.

    The words are those of `find_rig` and `describe_rig`. Neither beams nor range are known of an export of flcav.
    """
    here = KnownLidar()
    if rig.beams is not None and not (path / FRAMES).is_file():
        here = KnownLidar((rig.beams, rig.beams), RANGE_M)
    return "; ".join(filter(None, (*rig.notes, describe_rig([rig.agent_from_lidar], here, config, trained))))


def open_evaluated(path: Path) -> tuple[KittiFolder, str | None]:
    """Return the evaluated frames of the KITTI folder `path`, and the list that names them; None: all that have labels.

    Raises `InputError` where a file is missing.
    """
    split = VALIDATION if (path / "ImageSets" / f"{VALIDATION}.txt").is_file() else None
    return KittiFolder.open(path, split, pictures=False), split


def evaluate_kitti(
    network: Second, path: Path, rig: LidarRig, progress: Report = ignore_progress
) -> BenchmarkEvaluation:
    """Return the AP|R40 of each class on the frames of `open_evaluated`, whose LiDAR is that of `rig`.

    Raises `InputError` where a file is missing, truncated or malformed.
    """
    refuse_files(network.config, path)
    folder, split = open_evaluated(path)
    if not len(folder):
        raise InputError(f"{path}: no frames to evaluate")
    _check_labels(folder)
    found = list(_detect(network, folder, rig, progress))
    bare = [one.frame.size for one in found if not folder.has_image(one.frame.name)]
    classes = [name for name in network.config.classes if name in LIMITS]
    inside = [select_shown(one.boxes, one.frame) for one in found]
    truths = [truth_of(one.frame) for one in found]
    return BenchmarkEvaluation(
        frames=len(found),
        split=split,
        targets={name: {level: _count(found, name, level) for level in LEVELS} for name in classes},
        benchmark=tuple(_score(found, name, kind, limits[name]) for name, (limits, kind) in product(classes, COMPARED)),
        false_positives={name: _count_wrong(found, name) for name in classes},
        threshold=THRESHOLD,
        bare=len(bare),
        bare_px=tuple(sorted({f"{width} x {height}" for height, width in bare})) or None,
        labelled=score_detections(inside, truths, tuple(classes)),
        counts=count_objects(inside, truths, classes),
    )


def _check_labels(folder: KittiFolder) -> None:
    """Raise `InputError` where hardly any labelled box has points, by frames that are evenly spread."""
    boxes = EmptyBoxes()
    for number in sorted({round(i) for i in np.linspace(0, len(folder) - 1, LOOKED)}):
        frame = folder.frame(number)
        labelled = frame.objects.boxes
        track = np.array([str(row) for row in range(len(labelled))], np.str_)
        boxes.count(labelled, [(frame.points, np.eye(4))], track, np.zeros(len(track)), "ego", frame.name, frame.name)
    boxes.refuse(folder.folder)


def _detect(network: Second, folder: KittiFolder, rig: LidarRig, progress: Report) -> Iterator[_Found]:
    move = level_mount(rig.agent_from_lidar, network.config)
    for number in range(len(folder)):
        frame = folder.frame(number)
        (boxes,) = detect_moved(network, [frame.points], [move], score_threshold=LOWEST_SCORE)
        yield _compare(boxes, replace(frame, points=frame.points[:0], image=frame.image[:0]), frame.size)
        progress(number + 1, len(folder), "")


def select_shown(boxes: Boxes, frame: KittiFrame) -> Boxes:
    """Return the boxes whose centre is inside the frame's image, or that overlap a labelled object.

    Objects outside the image have no labels; of those that reach into it, the centre may lie outside.
    """
    blank = np.broadcast_to(np.uint8(0), (*frame.size, 3))
    shown = kitti_view(blank, frame.calibration).shows(boxes.center)
    on_one = iou(torch.from_numpy(boxes.array()), torch.from_numpy(frame.objects.boxes.array()), "bev") > 0
    return boxes[shown | on_one.any(dim=1).numpy()]


def truth_of(frame: KittiFrame) -> FrameTruth:
    """Return all labelled objects of a frame as targets, or as neutral where they are of a similar class."""
    boxes = frame.objects.boxes
    similar = np.array([NEUTRAL.get(str(name), "") for name in boxes.label], dtype=np.str_)
    neutral = replace(boxes, label=similar)[similar != ""]
    return FrameTruth(frame.name, boxes[similar == ""], neutral, boxes[:0])


def _compare(boxes: Boxes, frame: KittiFrame, size: tuple[int, ...]) -> _Found:
    """Return the detections of a frame with their overlaps; `size`: height and width of the image [px]."""
    rectangle = project_boxes(boxes, frame.calibration, size)
    detected = torch.from_numpy(boxes.array())
    labelled = torch.from_numpy(frame.objects.boxes.array())
    shared = _intersect(rectangle, frame.objects.rectangle)
    area = _area(rectangle)[:, None]
    other = _area(frame.objects.rectangle)
    inside = _intersect(rectangle, frame.objects.unlabelled) / np.maximum(area, 1e-9)
    return _Found(
        boxes,
        rectangle,
        frame,
        {
            "image": shared / np.maximum(area + other - shared, 1e-9),
            "bev": iou(detected, labelled, "bev").numpy(),
            "3d": iou(detected, labelled, "3d").numpy(),
        },
        inside.max(axis=1, initial=0.0),
    )


def project_boxes(boxes: Boxes, calibration: KittiCalibration, size: Sequence[int]) -> Array:
    """Return rectangles (D, 4) [px] of boxes (LiDAR frame) within an image of `size` (height, width); 0 outside it."""
    height, width = size
    rectangles = np.zeros((len(boxes), 4))
    for row, corners in enumerate(boxes.corners()):
        seen = clip_in_front(transform_points(calibration.camera_from_lidar, corners), BOX_EDGES, NEAR_M)
        if len(seen):
            pixels = np.c_[seen, np.ones(len(seen))] @ calibration.image_from_camera.T
            pixels = pixels[:, :2] / pixels[:, 2:]
            edges = np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))
            rectangles[row] = np.clip(edges, 0, [width - 1, height - 1, width - 1, height - 1])
    return rectangles


def _score(found: Sequence[_Found], name: str, kind: BenchmarkKind, limit: float) -> BenchmarkScore:
    ap = [average_precision_r40([_of_class(one, name, level, kind) for one in found], limit) for level in LEVELS]
    return BenchmarkScore(name, kind, limit, *(None if value is None else round(value, 6) for value in ap))


def _count_wrong(found: Sequence[_Found], name: str) -> int:
    """Return the number of unmatched detections of a class, scoring `THRESHOLD` or more, outside DontCare regions."""
    frames = [replace(_of_class(one, name, "hard", "3d"), excused=one.unlabelled > LOOSE[name]) for one in found]
    return sum(count_matches(frame, LOOSE[name], THRESHOLD)[1] for frame in frames)


def _of_class(found: _Found, name: str, level: str, kind: BenchmarkKind) -> ClassFrame:
    assert found.boxes.score is not None
    excused = found.unlabelled > LIMITS[name] if kind == "image" else np.zeros(len(found.boxes), bool)
    return ClassFrame(
        score=found.boxes.score,
        detection=detection_states(name, found.boxes.label, _height(found.rectangle), LEVELS[level]),
        label=_label(found, name, level),
        overlap=found.overlap[kind],
        excused=excused,
    )


def _label(found: _Found, name: str, level: str) -> Ints:
    known = found.frame.objects
    heights = _height(known.rectangle)
    return label_states(name, known.boxes.label, heights, known.occlusion, known.truncation, LEVELS[level])


def _count(found: Sequence[_Found], name: str, level: str) -> int:
    return sum(int((_label(one, name, level) == COUNTS).sum()) for one in found)


def _height(rectangle: Array) -> Array:
    return rectangle[:, 3] - rectangle[:, 1]


def _area(rectangle: Array) -> Array:
    return (rectangle[:, 2:] - rectangle[:, :2]).prod(axis=1)


def _intersect(one: Array, other: Array) -> Array:
    """Return the intersection areas (D, K) [px^2] of rectangles (D, 4) with (K, 4)."""
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    return np.clip(high - low, 0, None).prod(axis=2)
