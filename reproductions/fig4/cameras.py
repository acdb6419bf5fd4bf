"""Cameras of roadside suites and the LiDARs beside them: whose cars are associated, and how far extrinsics are off.

The LiDAR's cars are those of the road detector, the camera's boxes those of the picture detector; which actors they are
is known from the ground truth, which measures and takes no part in the association.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.dataset.rectangles import HALF_PX
from flcav.dataset.store import Dataset
from flcav.fusion.association import (
    AssociatedCamera,
    PairedShot,
    Pairs,
    correct_extrinsics,
    measure_error,
    pair,
    spread_of_calibration,
)
from flcav.fusion.registration import Offset, measure_offset
from flcav.fusion.road import PICTURE_THRESHOLD, load_picture_network
from flcav.geometry import Boxes, inverse
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.truth import CARS
from flcav.perception.ops.boxes import rectangle_iou
from flcav.perception.signs.predict import detect_in_picture
from flcav.perception.signs.samples import picture_reader
from flcav.sensors.frame import Annotations, Calibration, Frame, Views
from flcav.sensors.rig import CalibrationError
from flcav.storage.markdown import format_table

CALIBRATED, CORRECTED, EXACT = "as calibrated", "corrected", "true extrinsics"
OVERLAP = 0.5  # bird's-eye IoU of a car that the LiDAR found, and IoU of one that the picture shows
VISIBLE_PX = 100  # least visible pixels of a car that counts
SURE_DEG, SURE_M = 0.05, 0.01  # how well extrinsics are known that are called exact

Detect = Callable[[int], Boxes]  # cars in the sweep of a frame, LiDAR frame


@dataclass(frozen=True)
class Associated:
    """The pairs of all pictures of one camera, by one choice of its extrinsics."""

    off: Offset  # of the extrinsics from the true ones
    squared_error: float | None  # in their own standard deviations, 6 in the mean if those are right; None: exact
    pairs: int
    right: int  # of the pairs, both of one actor
    found: int  # of the pictures' cars, in a right pair
    lone_cars: int  # of the LiDAR's, in the picture
    lone_boxes: int  # of the picture's
    residual_px: float | None  # median over pairs; None without any


@dataclass(frozen=True)
class CameraResult:
    """A camera beside a LiDAR, over a window of pictures."""

    name: str
    pictures: int
    cars: int  # found by the LiDAR, with `VISIBLE_PX` in a picture
    pictured: int  # of these, with a box in the picture
    by_extrinsics: dict[str, Associated]  # `CALIBRATED`, `CORRECTED`, `EXACT`
    settled: bool  # whether the corrected pairs stayed, see `flcav.fusion.association.Association`


@dataclass(frozen=True)
class Known:
    """Actors of the cars and of the boxes of one shot, as rows of the frame's annotations; -1: none."""

    cars: NDArray[np.int64]  # (N,) of the LiDAR's cars
    boxes: NDArray[np.int64]  # (M,) of the picture's boxes
    visible: NDArray[np.bool_]  # (N,) whether the LiDAR's car is an actor that shows in the picture


def associate_camera(
    data: Dataset, agent: str, lidar: str, camera: str, name: str, find: Detect, error: CalibrationError
) -> CameraResult:
    """Return how the cars of a pole's LiDAR and of its camera are associated, over all frames of the pole in `data`.

    `error` says how far either sensor's mount may be off from its calibration, in standard deviations.
    """
    network, numbers = load_picture_network(), data.select(agents={agent})
    read = picture_reader(data, network.config.background)
    made = []
    for number in numbers:
        boxes = detect_in_picture(network, read(number, camera), threshold=PICTURE_THRESHOLD).box
        made.append(name_actors(data.frame(number), lidar, camera, PairedShot(find(number), boxes)))
    shots, known = [shot for shot, _ in made], [actors for _, actors in made]
    height, width = data.plane(numbers[0], camera, "rgb").shape[:2]
    both, size = data.calibrations[agent], (width, height)
    apart = np.sqrt(2)  # both mounts are off
    prior = spread_of_calibration(apart * error.rotation_deg, apart * error.position_m)
    true = make_view(both.true, lidar, camera, size, spread_of_calibration(SURE_DEG, SURE_M))
    calibrated = make_view(both.assumed, lidar, camera, size, prior)
    corrected = correct_extrinsics(shots, calibrated)

    def judge(pairs: Sequence[Pairs], view: AssociatedCamera) -> Associated:
        off = measure_offset(true.camera_from_lidar, view.camera_from_lidar)
        return judge_pairs(pairs, known, off, None if view is true else measure_error(true.camera_from_lidar, view))

    return CameraResult(
        name,
        len(shots),
        sum(int(each.visible.sum()) for each in known),
        sum(int((each.visible & np.isin(each.cars, each.boxes)).sum()) for each in known),
        {
            CALIBRATED: judge([pair(shot, calibrated) for shot in shots], calibrated),
            CORRECTED: judge(corrected.pairs, corrected.view),
            EXACT: judge([pair(shot, true) for shot in shots], true),
        },
        corrected.settled,
    )


def make_view(
    calibration: Calibration, lidar: str, camera: str, size: tuple[int, int], covariance: NDArray[np.float64]
) -> AssociatedCamera:
    """Return the view of a camera beside a LiDAR by an agent's calibration; size: width, height of its picture [px]."""
    mounts = calibration.agent_from_sensor
    return AssociatedCamera(
        inverse(mounts[camera]) @ mounts[lidar],
        covariance,
        calibration.intrinsics[camera],
        calibration.distortion[camera],
        size,
    )


def judge_pairs(
    pairs: Sequence[Pairs], known: Sequence[Known], off: Offset, squared_error: float | None = None
) -> Associated:
    """Return the counts over all shots of one camera, whose extrinsics are off by `off`."""
    right = [
        (own.cars[each.car] >= 0) & (own.cars[each.car] == own.boxes[each.box])
        for each, own in zip(pairs, known, strict=True)
    ]
    found = [ok & own.visible[each.car] for each, own, ok in zip(pairs, known, right, strict=True)]
    residual_px = np.concatenate([each.residual_px for each in pairs])
    return Associated(
        off,
        squared_error,
        len(residual_px),
        sum(int(ok.sum()) for ok in right),
        sum(int(ok.sum()) for ok in found),
        sum(len(each.lone_cars) for each in pairs),
        sum(len(each.lone_boxes) for each in pairs),
        float(np.median(residual_px)) if len(residual_px) else None,
    )


def name_actors(frame: Frame, lidar: str, camera: str, shot: PairedShot) -> tuple[PairedShot, Known]:
    """Return what LiDAR and camera found in a frame, and which actors that is."""
    truth, views = frame.annotations, frame.annotations.views[camera]
    rows = _actors_of_cars(shot.cars.transform(frame.world_from_sensor(lidar)), truth)
    visible = rows >= 0
    visible[visible] = views.pixels[rows[visible]] >= VISIBLE_PX
    return shot, Known(rows, _actors_of_boxes(shot.boxes, views), visible)


def _actors_of_cars(cars: Boxes, truth: Annotations) -> NDArray[np.int64]:
    """Return (N,) the annotation of each of the LiDAR's cars, world frame; -1 for none."""
    own = np.flatnonzero(np.isin(truth.boxes.label, CARS))
    target = assign_targets(cars, replace(truth.boxes[own], label=np.full(len(own), "Car")), OVERLAP, "bev")
    return np.where(target >= 0, own[target], -1) if len(own) else target


def _actors_of_boxes(boxes: NDArray[np.float64], views: Views) -> NDArray[np.int64]:
    """Return (M,) the annotation whose visible pixels each of a picture's boxes is around; -1 for none."""
    shown = np.flatnonzero(views.pixels > 0)
    if not len(boxes) or not len(shown):
        return np.full(len(boxes), -1)
    overlap = rectangle_iou(torch.from_numpy(boxes), torch.from_numpy(views.visible_box[shown] + HALF_PX)).numpy()
    return np.where(overlap.max(axis=1) >= OVERLAP, shown[overlap.argmax(axis=1)], -1)


def tabulate_cameras(cameras: Sequence[CameraResult]) -> str:
    """Return a row for each camera and choice of its extrinsics, as Markdown."""
    header = (
        "camera",
        "extrinsics",
        "off",
        "squared error [sd²]",
        "cars",
        "with a box",
        "rightly associated",
        "pairs",
        "of one car",
        "cars alone",
        "boxes alone",
        "residual [px]",
    )
    rows = [
        [
            each.name,
            name,
            f"{own.off.position_cm:.0f} cm, {own.off.rotation_deg:.2f}°",
            "" if own.squared_error is None else f"{own.squared_error:.1f}",
            each.cars,
            each.pictured,
            f"{own.found} ({own.found / each.cars:.2f})" if each.cars else "",
            own.pairs,
            f"{own.right} ({own.right / own.pairs:.2f})" if own.pairs else "",
            own.lone_cars,
            own.lone_boxes,
            "" if own.residual_px is None else f"{own.residual_px:.1f}",
        ]
        for each in cameras
        for name, own in each.by_extrinsics.items()
    ]
    return format_table(header, rows)
