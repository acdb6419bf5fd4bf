"""Export to KITTI's 3D object detection benchmark, as OpenPCDet and the development kit read it.

A frame is a spin of an agent with a LiDAR and a level camera that looks ahead. This camera stands for all four of
KITTI's cameras, and its optical frame for the rectified camera frame.
"""

import csv
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.formats.kitti.files import CLASSES as KITTI_CLASSES
from flcav.dataset.formats.writing import (
    SPLITS,
    Exported,
    ExportFormat,
    ExportOptions,
    LeftOut,
    check_rectified,
    count_readable_points,
    count_unwritten,
    find_front_camera,
    lacks_points,
    missing_data_error,
    read_frame,
    select_objects,
    split_scenes,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.geometry import Array, inverse, transform_points, wrap_angle
from flcav.interface.progress import Report
from flcav.sensors.frame import Frame

CLASSES = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "motorcycle": "Cyclist",
    "bicycle": "Cyclist",
    "pedestrian": "Pedestrian",
}
PARTLY, LARGELY = 0.1, 0.5  # occlusion from which an object counts as partly, and as largely occluded
UNKNOWN = 3  # KITTI's occlusion level of objects without a visible pixel
NOTHING = "DontCare -1 -1 -10 0 0 1 1 -1 -1 -1 -1000 -1000 -1000 -10"  # in a frame without labels: readers need a line
FRAMES = "frames.csv"  # maps each number to a frame of the dataset


def export_kitti(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write `dataset` as `training` and `ImageSets`, or as `testing` if it was recorded for tests: see `ExportFormat`.

    Frames without a LiDAR or a level camera that looks ahead are left out.
    """
    split_of = split_scenes(dataset, options)
    numbers: dict[str, list[str]] = defaultdict(list)
    rows = []
    exported = Exported(Counter(frames=0, objects=0, DontCare_regions=0))
    counts = exported.counts
    for i, key in enumerate(dataset.keys):
        frame = read_frame(dataset, i, options)
        camera = find_front_camera({name: frame.calibration.agent_from_sensor[name] for name in frame.images})
        if camera is None or not frame.lidar:
            exported.leave_out(frame, "no level camera that looks ahead" if frame.lidar else "no LiDAR", frame.agent)
        else:
            split = split_of[key.scene]
            number = f"{counts['frames']:06d}"
            folder = out / ("testing" if split == "test" else "training")
            objects, regions, left_out = _write_frame(frame, camera, folder, number, options.min_points)
            numbers[split].append(number)
            counts.update(frames=1, objects=objects, DontCare_regions=regions)
            exported.left_out.update(left_out)
            rows.append((number, split, frame.key, frame.agent, f"{frame.time_s:.3f}", camera))
        progress(i + 1, len(dataset), "")
    if not rows:
        raise missing_data_error(dataset, "KITTI", "agents with a LiDAR and a level camera that looks ahead")
    for split in SPLITS:
        _write_lines(out / "ImageSets" / f"{split}.txt", numbers[split])
    _write_lines(out / "ImageSets" / "trainval.txt", sorted(numbers["train"] + numbers["val"]))
    with (out / FRAMES).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("number", "split", "frame", "agent", "time_s", "camera"), *rows])
    return exported


EXPORT = ExportFormat(export_kitti, ("validation", "min_points", "calibration"))


def _write_frame(
    frame: Frame, camera: str, folder: Path, number: str, min_points: int
) -> tuple[int, int, Counter[LeftOut]]:
    lidar = next(iter(frame.lidar))
    mounts = frame.calibration.agent_from_sensor
    check_rectified(frame, camera, "KITTI")
    objects, regions, left_out = format_label_lines(frame, camera, lidar, min_points)
    _write_lines(folder / "label_2" / f"{number}.txt", objects + regions or [NOTHING])
    _write_lines(
        folder / "calib" / f"{number}.txt",
        format_calibration(
            frame.calibration.intrinsics[camera],
            camera_from_lidar=inverse(frame.world_from_sensor(camera)) @ frame.world_from_sensor(lidar),
            lidar_from_imu=inverse(mounts[lidar]) @ mounts.get(next(iter(frame.imu), ""), np.eye(4)),
        ),
    )
    write_file(folder / "velodyne" / f"{number}.bin", frame.lidar[lidar].astype("<f4").tobytes())
    write_file(folder / "image_2" / f"{number}.png", encode_png(frame.images[camera].rgb))
    return len(objects), len(regions), left_out + count_unwritten("KITTI", frame, {lidar, camera})


def format_label_lines(
    frame: Frame, camera: str, lidar: str, min_points: int
) -> tuple[list[str], list[str], Counter[LeftOut]]:
    """Return the lines of a label file, for labelled actors and for DontCare regions around other visible actors.

    Labelled are actors in the image and ahead of the camera with at least `min_points` LiDAR points in their box, and
    at least one point or visible pixel. The others are counted by reason.
    """
    truth = frame.annotations
    views = frame.annotations.views[camera]
    height, width = frame.images[camera].rgb.shape[:2]
    edge = (width - 1, height - 1, width - 1, height - 1)
    rectangle = np.clip(views.amodal_box, 0, edge)
    within = (rectangle[:, 2:] > rectangle[:, :2]).all(axis=1)  # False where the box is NaN
    camera_from_world = inverse(frame.world_from_sensor(camera))
    boxes = truth.boxes
    axes = boxes.rotations()
    bottom = transform_points(camera_from_world, boxes.center - axes[:, :, 2] * boxes.size[:, 2:] / 2)
    ahead = axes[:, :, 0] @ camera_from_world[:3, :3].T
    rotation = wrap_angle(np.arctan2(-ahead[:, 2], ahead[:, 0]))
    alpha = wrap_angle(rotation - np.arctan2(bottom[:, 0], bottom[:, 2]))
    level = occlusion_levels(views.occlusion, views.pixels)
    points, shows = count_readable_points(frame, lidar, frame.lidar[lidar]), views.pixels > 0
    reasons = {
        "outside the image": ~within | (bottom[:, 2] <= 0),
        lacks_points(min_points): points < min_points,
        "neither a LiDAR point nor a visible pixel": ~shows & (points == 0),
    }
    labelled, left_out = select_objects("KITTI", boxes.label, [*CLASSES, *KITTI_CLASSES], reasons)
    lines = []
    for i in np.flatnonzero(labelled):
        length, breadth, tall = boxes.size[i]
        numbers = (*rectangle[i], tall, breadth, length, *bottom[i], rotation[i])
        lines.append(
            f"{CLASSES.get(str(boxes.label[i]), boxes.label[i])} {views.truncation[i]:.4f} {level[i]} {alpha[i]:.4f} "
            + " ".join(f"{number:.4f}" for number in numbers)
        )
    regions = [dont_care(np.clip(views.visible_box[i], 0, edge)) for i in np.flatnonzero(shows & ~labelled)]
    return lines, regions, left_out


def dont_care(rectangle: Array) -> str:
    """Return the label line of a DontCare region, given left, top, right, bottom (4,) [px]."""
    left, top, right, bottom = (f"{number:.4f}" for number in rectangle)
    return f"DontCare -1 -1 -10 {left} {top} {right} {bottom} -1 -1 -1 -1000 -1000 -1000 -10"


def occlusion_levels(occlusion: Array, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return KITTI's occlusion levels (M,): 0 fully visible, 1 partly occluded, 2 largely occluded, 3 unknown.

    `occlusion` (M,) is in [0, 1] or NaN, `pixels` (M,) is the number of visible ones.
    """
    level = np.digitize(occlusion, (PARTLY, LARGELY))
    return np.where((pixels != 0) & ~np.isnan(occlusion), level, UNKNOWN)


def format_calibration(intrinsics: Array, camera_from_lidar: Array, lidar_from_imu: Array) -> list[str]:
    """Return the lines of a calibration file, in the order that readers expect.

    `intrinsics` is (3, 3) [px]; the transforms are (4, 4) [m].
    """
    projection = np.column_stack((intrinsics, np.zeros(3)))
    matrices = {
        **{f"P{i}": projection for i in range(4)},
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": camera_from_lidar[:3],
        "Tr_imu_to_velo": lidar_from_imu[:3],
    }
    return [f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.flat) for name, matrix in matrices.items()]


def _write_lines(path: Path, lines: list[str]) -> None:
    write_file(path, "".join(f"{line}\n" for line in lines))
