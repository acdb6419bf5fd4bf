"""Inference of SECOND: decoding of anchors, score calibration, non-maximum suppression; detections as JSON records."""

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flcav.geometry import Boxes, concatenate, inverse, pose
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import LOG_VARIANCES, HeadOutput, Second
from flcav.perception.objects.samples import move_points
from flcav.perception.objects.targets import anchor_boxes, anchor_classes, decode, decode_variance
from flcav.perception.objects.truth import QUARTERS, FrameTruth, asked_of, choose_lidar, in_range, network_from_lidar
from flcav.perception.ops.rotated import nms
from flcav.perception.ops.sparse import SparseTensor
from flcav.perception.task import Result
from flcav.sensors.frame import Frame
from flcav.storage.records import Class

LOWEST_SCORE = 0.05  # of detections that are evaluated; lower ones change AP by less than its interval
CANDIDATES = 256  # anchors of highest score per class that enter non-maximum suppression


@dataclass(frozen=True)
class ObjectFound:
    """A detected object: class, score and 3D box, LiDAR frame (x forward, y left, z up)."""

    label: Class
    score: float  # [0, 1]
    x: float  # of the box's centre [m]
    y: float
    z: float
    length: float  # [m]
    width: float
    height: float
    yaw: float  # counter-clockwise from the x axis [rad]


@dataclass(frozen=True)
class ObjectsFound(Result):
    """The objects detected in a point cloud."""

    boxes: tuple[ObjectFound, ...]

    def lines(self) -> list[str]:
        """Return the number of objects, then one line per box."""
        lines = [plural(len(self.boxes), "object")]
        for box in self.boxes:
            place = f"at ({box.x:.1f}, {box.y:.1f}, {box.z:.1f}) m, yaw {box.yaw:.2f} rad"
            size = f"{box.length:.1f} x {box.width:.1f} x {box.height:.1f} m"
            lines.append(f"{box.label:<11}{box.score:.2f}  {place}, {size}")
        return lines


def detect(network: Second, points: NDArray[np.float32], *, score_threshold: float = 0.1) -> Boxes:
    """Return the boxes detected in a point cloud (N, 4) x, y, z [m], intensity [0, 1], LiDAR frame.

    They have class labels and scores of at least `score_threshold`, class by class, highest score first, and variances
    where the network predicts them.
    """
    return detect_all(network, [points], score_threshold=score_threshold)[0]


def detect_in(network: Second, frames: Sequence[Frame], *, score_threshold: float = 0.1) -> list[Boxes]:
    """Return the boxes detected in the sweep of each frame's first LiDAR as `detect` does, LiDAR frame.

    Sweeps are moved to the height and direction that the network was trained for, see `network_from_lidar`. Raises
    `InputError` where a frame has no LiDAR.
    """
    clouds = [frame.lidar[choose_lidar(frame)] for frame in frames]
    moves = [network_from_lidar(frame, network.config) for frame in frames]
    return detect_moved(network, clouds, moves, score_threshold=score_threshold)


def detect_moved(
    network: Second,
    clouds: Sequence[NDArray[np.float32]],
    moves: Sequence[NDArray[np.float64] | None],
    *,
    score_threshold: float = 0.1,
) -> list[Boxes]:
    """Return the boxes detected in each point cloud as `detect` does, in the frame of its points.

    A cloud's move (4, 4) brings it to the frame that the network was trained in; None: it is there.
    """
    moved = [move_points(cloud, move) for cloud, move in zip(clouds, moves, strict=True)]
    found = detect_all(network, moved, score_threshold=score_threshold)
    return [boxes if move is None else boxes.transform(inverse(move)) for boxes, move in zip(found, moves, strict=True)]


def detect_all(
    network: Second, clouds: Sequence[NDArray[np.float32]], *, score_threshold: float = 0.1, batch: int = 4
) -> list[Boxes]:
    """Return the boxes detected in each point cloud as `detect` does, `batch` clouds at a time.

    With `around` in its configuration the network looks at each cloud four times, turned by quarters, and what two
    looks found is suppressed as within one. It runs in evaluation mode; its mode is restored.
    """
    if not network.config.around:
        return _detect_ahead(network, clouds, score_threshold, batch)
    looks = []
    for turns in range(QUARTERS):
        found = _detect_ahead(network, [_turn(cloud, -turns) for cloud in clouds], score_threshold, batch)
        looks.append([boxes.transform(pose(0, 0, yaw=turns * math.pi / 2)) for boxes in found])
    return [
        _suppress(concatenate(parts), network.config.classes) if any(map(len, parts)) else parts[0]
        for parts in zip(*looks, strict=True)
    ]


def look_around(network: Second) -> Second:
    """Return a network of the same weights that looks to all four sides, see `detect_all`."""
    turning = copy.copy(network)
    turning.config = replace(network.config, around=True)
    return turning


def _turn(points: NDArray[np.float32], quarters: int) -> NDArray[np.float32]:
    """Return the points turned by so many quarters to the left about the sensor, exactly."""
    x, y = points[:, 0], points[:, 1]
    for _ in range(quarters % QUARTERS):
        x, y = -y, x
    return np.column_stack((x, y, points[:, 2:]))


def _suppress(boxes: Boxes, classes: Sequence[str]) -> Boxes:
    """Return the boxes left by non-maximum suppression, class by class, highest score first."""
    assert boxes.score is not None
    kept = []
    for name in classes:
        own = np.flatnonzero(boxes.label == name)
        own = own[np.argsort(-boxes.score[own], kind="stable")]
        kept.append(own[nms(torch.from_numpy(boxes.array()[own]), torch.from_numpy(boxes.score[own])).numpy()])
    return boxes[np.concatenate(kept)]


def _detect_ahead(
    network: Second, clouds: Sequence[NDArray[np.float32]], score_threshold: float, batch: int
) -> list[Boxes]:
    training = network.training
    network.eval()
    found: list[Boxes] = []
    with torch.inference_mode():
        for first in range(0, len(clouds), batch):
            output = predict(network, clouds[first : first + batch])
            score = calibrate_logits(output.score, network.config).sigmoid().cpu().numpy()
            box = output.box.double().cpu().numpy()
            direction = output.direction.argmax(2).cpu().numpy()
            spread = [None] * len(score)
            if output.log_variance is not None:
                spread = output.log_variance.double().clamp(*LOG_VARIANCES).exp().cpu().numpy()
            parts = zip(score, box, direction, spread, strict=True)
            found += [_decode_boxes(network, *one, score_threshold) for one in parts]
    network.train(training)
    return found


def detect_frames(
    network: Second,
    frames: Iterable[Frame],
    asked: SecondConfig | None = None,
    *,
    total: int = 0,
    progress: Report = ignore_progress,
) -> tuple[list[Boxes], list[FrameTruth]]:
    """Return the detections of `network` in each frame, from `LOWEST_SCORE` on, and the ground truth of each frame.

    asked: a configuration of smaller range (None: the network's own); objects beyond it are neutral, and detections
    beyond it are dropped. total: number of frames where it is known, for `progress`. Raises `InputError` where a frame
    has no LiDAR.
    """
    truths: list[FrameTruth] = []
    detections: list[Boxes] = []
    for done, frame in enumerate(frames, start=1):
        truths.append(asked_of(frame, asked or network.config))
        (found,) = detect_in(network, [frame], score_threshold=LOWEST_SCORE)
        detections.append(found if asked is None else found[in_range(found, asked)])
        progress(done, max(total, done), "")
    return detections, truths


def predict(network: Second, clouds: Sequence[NDArray[np.float32]]) -> HeadOutput:
    """Return the raw predictions of `network` for a batch of point clouds (N_i, 4), LiDAR frame, on its device."""
    return network(voxels_of(network, clouds))


def voxels_of(network: Second, clouds: Sequence[NDArray[np.float32]]) -> SparseTensor | Tensor:
    """Return the input of `network` for a batch of point clouds (N_i, 4), LiDAR frame, on its device."""
    device = network.head.weight.device
    points = torch.from_numpy(np.concatenate(clouds)).to(device)
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=device)
    sample = torch.repeat_interleave(torch.arange(len(clouds), device=device), sizes)
    return network.voxels(points, sample, len(clouds))


def calibrate_logits(logits: Tensor, config: SecondConfig) -> Tensor:
    """Return the calibrated logits (..., classes), whose sigmoid is the score; unchanged without a calibration."""
    if config.calibration is None:
        return logits
    factor, summand = logits.new_tensor(config.calibration).T
    return logits * factor + summand


def boxes_to_rows(boxes: Boxes) -> tuple[ObjectFound, ...]:
    """Return the boxes as records, one per box; a score that is not known is 1."""
    scores = boxes.score if boxes.score is not None else np.ones(len(boxes))
    rows = zip(boxes.label.tolist(), scores.tolist(), boxes.array().tolist(), strict=True)
    return tuple(ObjectFound(label, score, *row) for label, score, row in rows)


def rows_to_boxes(rows: Sequence[ObjectFound]) -> Boxes:
    """Return the records as boxes: the inverse of `boxes_to_rows`."""
    array = np.array([(b.x, b.y, b.z, b.length, b.width, b.height, b.yaw) for b in rows]).reshape(-1, 7)
    return Boxes.from_array(array, [row.label for row in rows], [row.score for row in rows])


def _decode_boxes(
    network: Second, score: NDArray, box: NDArray, direction: NDArray, spread: NDArray | None, threshold: float
) -> Boxes:
    config = network.config
    parts = []
    for index, name in enumerate(config.classes):
        own = np.flatnonzero(anchor_classes(config) == index)
        scores = score[own, index]
        likely = np.argsort(-scores, kind="stable")[:CANDIDATES]
        likely = likely[scores[likely] >= threshold]
        own, scores = own[likely], scores[likely]
        anchors = anchor_boxes(config)[own]
        rows = decode(box[own], direction[own], anchors)
        kept = nms(torch.from_numpy(rows), torch.from_numpy(scores)).numpy()
        found = Boxes.from_array(rows[kept], name, scores[kept])
        if spread is not None:
            found = replace(found, variance=decode_variance(spread[own][kept], rows[kept], anchors[kept]))
        parts.append(found)
    return concatenate(parts)
