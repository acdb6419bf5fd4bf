"""Inference of SECOND: decoding of anchors, non-maximum suppression, score calibration, and findings of point clouds.

Scores are calibrated by Platt scaling, and their reliability is measured per class: expected calibration error (ECE)
and the ratio of squared errors to predicted variances. Point clouds are read from files, folders and datasets.
"""

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flcav.arrays import Array, Array32
from flcav.dataset.formats.sweeps import list_cloud_files, read_cloud_file
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, concatenate, inverse, pose
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.device import inference
from flcav.perception.images import CameraView, recorded_view, view_beside
from flcav.perception.marks import CloudBoxes
from flcav.perception.metrics import calibration_error, fit_logistic, match, round_or_none
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.loss import anchor_boxes, anchor_classes, decode_residuals, decode_variance
from flcav.perception.objects.modalities import frames_beside, read_cloud, refuse_files, widen
from flcav.perception.objects.model import LOG_VARIANCES, SPEED_M_S, HeadOutput, Second
from flcav.perception.objects.samples import move_points, validate_points
from flcav.perception.objects.truth import (
    QUARTERS,
    FrameTruth,
    asked_of,
    choose_lidar,
    in_range,
    level_mount,
    network_from_lidar,
    select_class,
    select_sides,
)
from flcav.perception.objects.velocities import take_speeds
from flcav.perception.ops.boxes import nms
from flcav.perception.ops.sparse import SparseTensor
from flcav.perception.task import Finding, Result
from flcav.sensors.frame import Frame
from flcav.storage.records import LEFT_OUT, Class

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
    speed: Annotated[float | None, LEFT_OUT] = None  # over ground, along the heading [m/s]; None where not predicted


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
            moves = "" if box.speed is None else f", {box.speed:.1f} m/s"
            lines.append(f"{box.label:<11}{box.score:.2f}  {place}, {size}{moves}")
        return lines


def detect(network: Second, points: Array32, *, score_threshold: float = 0.1) -> Boxes:
    """Return the boxes detected in a point cloud (N, 4) x, y, z [m], intensity [0, 1], LiDAR frame.

    They have class labels and scores of at least `score_threshold`, class by class, highest score first, and variances
    if the network predicts them.
    """
    return detect_all(network, [points], score_threshold=score_threshold)[0]


def detect_in(network: Second, frames: Sequence[Frame], *, score_threshold: float = 0.1) -> list[Boxes]:
    """Return the boxes detected in the sweep of each frame's first LiDAR as `detect` does, LiDAR frame.

    Sweeps are moved to the height and direction that the network was trained for, see `network_from_lidar`. Raises
    `InputError` where a frame has no LiDAR.
    """
    clouds = [read_cloud(frame, network.config) for frame in frames]
    moves = [network_from_lidar(frame, network.config) for frame in frames]
    return detect_moved(network, clouds, moves, score_threshold=score_threshold)


def detect_moved(
    network: Second,
    clouds: Sequence[Array32],
    moves: Sequence[Array | None],
    *,
    score_threshold: float = 0.1,
) -> list[Boxes]:
    """Return the boxes detected in each point cloud as `detect` does, in the frame of its points.

    A cloud's move (4, 4) brings it to the frame that the network was trained in; None: it is already in that frame.
    """
    moved = [move_points(cloud, move) for cloud, move in zip(clouds, moves, strict=True)]
    found = detect_all(network, moved, score_threshold=score_threshold)
    return [boxes if move is None else boxes.transform(inverse(move)) for boxes, move in zip(found, moves, strict=True)]


def detect_all(
    network: Second, clouds: Sequence[Array32], *, score_threshold: float = 0.1, batch: int = 4
) -> list[Boxes]:
    """Return the boxes detected in each point cloud as `detect` does, `batch` clouds at a time.

    With `around` in its configuration the network looks at each cloud four times, turned by quarters, and detections
    from two looks suppress one another as those of one look do. It runs in evaluation mode; its mode is restored.
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


def _turn(points: Array32, quarters: int) -> Array32:
    """Return the points rotated exactly by a number of quarter turns to the left about the sensor."""
    x, y = points[:, 0], points[:, 1]
    for _ in range(quarters % QUARTERS):
        x, y = -y, x
    return np.column_stack((x, y, points[:, 2:]))


def _suppress(boxes: Boxes, classes: Sequence[str]) -> Boxes:
    """Return the boxes left by non-maximum suppression, class by class, highest score first."""
    assert boxes.score is not None
    kept = []
    for name in classes:
        rows = np.flatnonzero(boxes.label == name)
        rows = rows[np.argsort(-boxes.score[rows], kind="stable")]
        kept.append(rows[nms(torch.from_numpy(boxes.array()[rows]), torch.from_numpy(boxes.score[rows])).numpy()])
    return boxes[np.concatenate(kept)]


def _detect_ahead(network: Second, clouds: Sequence[Array32], score_threshold: float, batch: int) -> list[Boxes]:
    found: list[Boxes] = []
    with inference(network):
        for first in range(0, len(clouds), batch):
            output = predict(network, clouds[first : first + batch])
            score = calibrate_logits(output.score, network.config).sigmoid().cpu().numpy()
            box = output.box.double().cpu().numpy()
            direction = output.direction.argmax(2).cpu().numpy()
            spread, speed = [None] * len(score), [None] * len(score)
            if output.log_variance is not None:
                spread = output.log_variance.double().clamp(*LOG_VARIANCES).exp().cpu().numpy()
            if output.speed is not None:
                speed = (output.speed[..., 0].double() * SPEED_M_S).cpu().numpy()
            parts = zip(score, box, direction, spread, speed, strict=True)
            decoded = [_decode_boxes(network, *one, score_threshold) for one in parts]
            if network.config.beside == "radar":
                seen = (widen(cloud, network.config.columns) for cloud in clouds[first : first + batch])
                decoded = [take_speeds(boxes, cloud) for boxes, cloud in zip(decoded, seen, strict=True)]
            found += decoded
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

    `asked` is a configuration of smaller range (None: the network's); objects beyond it are neutral, and detections
    beyond it are dropped. `total` is the number of frames, if known, for `progress`. Raises `InputError` where a frame
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


def predict(network: Second, clouds: Sequence[Array32]) -> HeadOutput:
    """Return the raw predictions of `network` for a batch of point clouds (N_i, C), LiDAR frame, on its device."""
    return network(voxels_of(network, clouds))


def voxels_of(network: Second, clouds: Sequence[Array32]) -> SparseTensor | Tensor:
    """Return the input of `network` for a batch of point clouds (N_i, C), LiDAR frame, on its device.

    Clouds of four columns are of the LiDAR alone, see `flcav.perception.objects.modalities`.
    """
    device = network.head.weight.device
    points = torch.from_numpy(np.concatenate([widen(cloud, network.config.columns) for cloud in clouds])).to(device)
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
    """Return the boxes as records, one per box; an unknown score becomes 1."""
    scores = boxes.score if boxes.score is not None else np.ones(len(boxes))
    speeds = [None] * len(boxes) if boxes.speed is None else boxes.speed.tolist()
    rows = zip(boxes.label.tolist(), scores.tolist(), boxes.array().tolist(), speeds, strict=True)
    return tuple(ObjectFound(label, score, *row, speed=speed) for label, score, row, speed in rows)


def rows_to_boxes(rows: Sequence[ObjectFound]) -> Boxes:
    """Return the records as boxes: the inverse of `boxes_to_rows`."""
    array = np.array([(b.x, b.y, b.z, b.length, b.width, b.height, b.yaw) for b in rows]).reshape(-1, 7)
    return Boxes.from_array(array, [row.label for row in rows], [row.score for row in rows])


def _decode_boxes(
    network: Second,
    score: NDArray,
    box: NDArray,
    direction: NDArray,
    spread: NDArray | None,
    speed: NDArray | None,
    threshold: float,
) -> Boxes:
    config = network.config
    parts = []
    for index, name in enumerate(config.classes):
        anchors_of_class = np.flatnonzero(anchor_classes(config) == index)
        scores = score[anchors_of_class, index]
        likely = np.argsort(-scores, kind="stable")[:CANDIDATES]
        likely = likely[scores[likely] >= threshold]
        anchors_of_class, scores = anchors_of_class[likely], scores[likely]
        anchors = anchor_boxes(config)[anchors_of_class]
        rows = decode_residuals(box[anchors_of_class], direction[anchors_of_class], anchors)
        kept = nms(torch.from_numpy(rows), torch.from_numpy(scores)).numpy()
        found = Boxes.from_array(rows[kept], name, scores[kept])
        if spread is not None:
            found = replace(found, variance=decode_variance(spread[anchors_of_class][kept], rows[kept], anchors[kept]))
        if speed is not None:
            found = replace(found, speed=speed[anchors_of_class][kept])
        parts.append(found)
    return concatenate(parts)


class InputCloud(NamedTuple):
    """A point cloud to detect objects in, LiDAR frame."""

    path: Path  # of the file; of a dataset, folder / key of the frame
    points: Array32  # (N, 4) x, y, z [m], intensity [0, 1]
    move: Array | None  # (4, 4) to the frame that the network was trained in; None: it is in that frame
    view: Callable[[], CameraView | None]  # reads the view of a camera with the same direction, None without one


def detect_objects(
    network: Second,
    path: Path,
    threshold: float,
    frames: Sequence[int] | None = None,
    mount: Array | None = None,
) -> Iterator[Finding]:
    """Yield the objects of score `threshold` or more in each point cloud of `path`, in the frame of its points.

    `path` is a point cloud file, see `read_cloud_file`, a folder of them, or a dataset folder, with its `frames` (None:
    all). `mount` (4, 4) [m] is that of the LiDAR of files, see `find_rigs` of `samples` (None: as the network expects).
    Raises `InputError` as `read_point_clouds` does.
    """
    for cloud in read_point_clouds(path, frames, network.config, mount):
        (found,) = detect_moved(network, [cloud.points], [cloud.move], score_threshold=threshold)
        yield Finding(cloud.path, cloud.points, ObjectsFound(boxes_to_rows(found)), (CloudBoxes(found),), cloud.view)


def read_point_clouds(
    path: Path, frames: Sequence[int] | None, config: SecondConfig, mount: Array | None = None
) -> Iterator[InputCloud]:
    """Yield the point clouds of a file, of a folder of them, or of `frames` (None: all) of a dataset folder.

    They are as a network of `config` sees them. `mount` is that of the LiDAR of files, see `detect_objects`. Raises
    `InputError` where `path` is none of these, a frame has no LiDAR, or a cloud is empty, truncated, of an unknown
    layout or not of numbers in range.
    """
    if (path / MANIFEST).is_file():
        return _recorded(path, frames, config)
    refuse_files(config, path)
    move = None if mount is None else level_mount(mount, config)
    return (
        InputCloud(file, validate_points(read_cloud_file(file), file), move, partial(view_beside, file))
        for file in list_cloud_files(path)
    )


def _recorded(folder: Path, frames: Sequence[int] | None, config: SecondConfig) -> Iterator[InputCloud]:
    dataset = Dataset.open(folder)
    read = frames_beside(dataset, config, dataset.numbers(frames))
    for i in dataset.numbers(frames):
        frame = read(i)
        lidar, origin = choose_lidar(frame), folder / frame.key
        points = read_cloud(frame, config, lidar)
        if not config.foreground:  # without its background, a street may be empty
            validate_points(frame.lidar[lidar], origin)
        yield InputCloud(origin, points, network_from_lidar(frame, config), partial(recorded_view, dataset, i, lidar))


OVERLAP = 0.5  # 3D IoU from which a detection is a true positive


def calibrate(network: Second, frames: Iterable[Frame]) -> None:
    """Set the Platt scaling in the configuration of `network`, fitted per class on frames not used for training.

    See `flcav.perception.metrics.detection.fit_logistic`.
    """
    network.config = replace(network.config, calibration=None)
    detections, truths = detect_frames(network, frames)
    fitted = []
    for name in network.config.classes:
        matches = match(*select_sides(detections, truths, name), OVERLAP)
        fitted.append(fit_logistic(matches.score, matches.hit))
    network.config = replace(network.config, calibration=tuple(fitted))


@dataclass(frozen=True)
class Reliability:
    """Reliability of a class's scores and predicted variances; None without detections or variances."""

    label: Class
    detections: int  # true and false positives
    ece: float | None  # expected calibration error of the scores, in [0, 1]
    variance_ratio: float | None  # mean squared error of x and y of true positives / mean predicted variance


def measure_reliability(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str]
) -> tuple[Reliability, ...]:
    """Return calibration error and variance ratio per class; detections and truths run over the same frames.

    A variance ratio of 1 is calibrated, above 1 overconfident, below 1 underconfident.
    """
    rows = []
    for name in classes:
        matches = match(*select_sides(detections, truths, name), OVERLAP)
        ece, ratio = calibration_error(matches.score, matches.hit), _variance_ratio(detections, truths, name)
        rows.append(Reliability(name, len(matches.score), round_or_none(ece), round_or_none(ratio)))
    return tuple(rows)


def _variance_ratio(detections: Sequence[Boxes], truths: Sequence[FrameTruth], name: str) -> float:
    error, variance = [0.0], [0.0]
    for boxes, truth in zip(detections, truths, strict=True):
        found, targets = select_class(boxes, name), select_class(truth.targets, name)
        if found.variance is None or not len(found):
            continue
        target = assign_targets(found, targets, OVERLAP)
        hit = target >= 0
        error += ((found.center[hit] - targets.center[target[hit]])[:, :2] ** 2).sum(1).tolist()
        variance += found.variance[hit, :2].sum(1).tolist()
    total = float(np.sum(variance))
    return float(np.sum(error)) / total if total else float("nan")
