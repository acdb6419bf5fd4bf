"""Association of cars between the cameras and LiDARs of roadside suites, and the errors of the cameras' extrinsics.

The LiDAR's cars are those of the road detector, the camera's boxes those of the picture detector. The ground truth says
which actors they are: it judges the association and takes no part in it.
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
SURE_DEG, SURE_M = 0.05, 0.01  # standard deviations assumed for the true extrinsics

Detect = Callable[[int], Boxes]  # cars in the sweep of a frame, LiDAR frame


@dataclass(frozen=True)
class Associated:
    """Counts of the pairs of cars and boxes over all pictures of one camera, for one choice of its extrinsics."""

    off: Offset  # of the extrinsics from the true ones
    squared_error: float | None  # squared Mahalanobis distance of that error: 6 in expectation; None: exact
    pairs: int
    right: int  # pairs whose car and box are one actor
    found: int  # of the LiDAR's cars that show in the picture, those in a right pair
    lone_cars: int  # the LiDAR's cars in the picture, without a box
    lone_boxes: int  # the picture's boxes, without a car
    residual_px: float | None  # median over pairs; None without any


@dataclass(frozen=True)
class CameraResult:
    """The associations of a camera with the LiDAR of its suite, over a window of pictures."""

    name: str
    pictures: int
    cars: int  # found by the LiDAR, with `VISIBLE_PX` in a picture
    pictured: int  # of these, with a box in the picture
    by_extrinsics: dict[str, Associated]  # `CALIBRATED`, `CORRECTED`, `EXACT`
    settled: bool  # whether the corrected pairs stayed, see `flcav.fusion.association.Association`


@dataclass(frozen=True)
class Known:
    """The actors that the cars and boxes of one shot are, as rows of the frame's annotations; -1: none."""

    cars: NDArray[np.int64]  # (N,) of the LiDAR's cars
    boxes: NDArray[np.int64]  # (M,) of the picture's boxes
    visible: NDArray[np.bool_]  # (N,) whether the LiDAR's car is an actor that shows in the picture


def associate_camera(
    data: Dataset, agent: str, lidar: str, camera: str, name: str, find: Detect, error: CalibrationError
) -> CameraResult:
    """Return how the cars of a pole's LiDAR and of its camera are associated, over all frames of the pole in `data`.

    `find` returns the LiDAR's cars of a frame; `error` gives the standard deviations of each mount from its
    calibration.
    """
    network, numbers = load_picture_network(), data.select(agents={agent})
    read = picture_reader(data, network.config.background)
    named = []
    for number in numbers:
        boxes = detect_in_picture(network, read(number, camera), threshold=PICTURE_THRESHOLD).box
        named.append(name_actors(data.frame(number), lidar, camera, PairedShot(find(number), boxes)))
    shots, known = [shot for shot, _ in named], [actors for _, actors in named]
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
        sum(int(actors.visible.sum()) for actors in known),
        sum(int((actors.visible & np.isin(actors.cars, actors.boxes)).sum()) for actors in known),
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
    """Return a camera's view of a LiDAR's cars by an agent's calibration; size: width, height of its picture [px]."""
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
        (actors.cars[matched.car] >= 0) & (actors.cars[matched.car] == actors.boxes[matched.box])
        for matched, actors in zip(pairs, known, strict=True)
    ]
    found = [
        is_right & actors.visible[matched.car] for matched, actors, is_right in zip(pairs, known, right, strict=True)
    ]
    residual_px = np.concatenate([matched.residual_px for matched in pairs])
    return Associated(
        off,
        squared_error,
        len(residual_px),
        sum(int(is_right.sum()) for is_right in right),
        sum(int(is_right.sum()) for is_right in found),
        sum(len(matched.lone_cars) for matched in pairs),
        sum(len(matched.lone_boxes) for matched in pairs),
        float(np.median(residual_px)) if len(residual_px) else None,
    )


def name_actors(frame: Frame, lidar: str, camera: str, shot: PairedShot) -> tuple[PairedShot, Known]:
    """Return `shot`, what LiDAR and camera found in a frame, and which actors its cars and boxes are."""
    truth, views = frame.annotations, frame.annotations.views[camera]
    rows = _actors_of_cars(shot.cars.transform(frame.world_from_sensor(lidar)), truth)
    visible = rows >= 0
    visible[visible] = views.pixels[rows[visible]] >= VISIBLE_PX
    return shot, Known(rows, _actors_of_boxes(shot.boxes, views), visible)


def _actors_of_cars(cars: Boxes, truth: Annotations) -> NDArray[np.int64]:
    """Return (N,) the row in `truth` of the actor that each of the LiDAR's cars is, world frame; -1 for none."""
    rows = np.flatnonzero(np.isin(truth.boxes.label, CARS))
    target = assign_targets(cars, replace(truth.boxes[rows], label=np.full(len(rows), "Car")), OVERLAP, "bev")
    return np.where(target >= 0, rows[target], -1) if len(rows) else target


def _actors_of_boxes(boxes: NDArray[np.float64], views: Views) -> NDArray[np.int64]:
    """Return (M,) the row of the actor whose visible pixels each of a picture's boxes encloses; -1 for none."""
    shown = np.flatnonzero(views.pixels > 0)
    if not len(boxes) or not len(shown):
        return np.full(len(boxes), -1)
    overlap = rectangle_iou(torch.from_numpy(boxes), torch.from_numpy(views.visible_box[shown] + HALF_PX)).numpy()
    return np.where(overlap.max(axis=1) >= OVERLAP, shown[overlap.argmax(axis=1)], -1)


def tabulate_cameras(cameras: Sequence[CameraResult]) -> str:
    """Return a Markdown table with a row for each camera and choice of its extrinsics."""
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
            camera.name,
            name,
            f"{counts.off.position_cm:.0f} cm, {counts.off.rotation_deg:.2f}°",
            "" if counts.squared_error is None else f"{counts.squared_error:.1f}",
            camera.cars,
            camera.pictured,
            f"{counts.found} ({counts.found / camera.cars:.2f})" if camera.cars else "",
            counts.pairs,
            f"{counts.right} ({counts.right / counts.pairs:.2f})" if counts.pairs else "",
            counts.lone_cars,
            counts.lone_boxes,
            "" if counts.residual_px is None else f"{counts.residual_px:.1f}",
        ]
        for camera in cameras
        for name, counts in camera.by_extrinsics.items()
    ]
    return format_table(header, rows)
