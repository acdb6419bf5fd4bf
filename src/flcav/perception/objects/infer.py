"""Point clouds of files, folders and datasets for inference, and detected objects as JSON records."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.kitti import read_points
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.perception.images import CameraView, recorded_view, view_beside
from flcav.perception.objects.samples import validate_points
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.task import Result
from flcav.records import Class


class Cloud(NamedTuple):
    """A point cloud to detect objects in, LiDAR frame."""

    path: Path  # of the file; of a dataset, folder / key of the frame
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1]
    view: Callable[[], CameraView | None]  # reads the view of a camera with the same direction, None without one


def read_point_clouds(path: Path, frames: Sequence[int] | None = None) -> Iterator[Cloud]:
    """Yield the point clouds of a KITTI .bin file, of a folder of them, or of `frames` (None: all) of a dataset folder.

    Raises `InputError` where `path` is none of these, a frame has no LiDAR, or a cloud is empty, truncated or not of
    finite numbers.
    """
    if (path / MANIFEST).is_file():
        clouds = _recorded(path, frames)
    elif path.is_dir():
        files = sorted(path.glob("*.bin"))
        if not files:
            raise InputError(f"{path}: neither a dataset nor a folder with .bin files")
        clouds = map(_of_file, files)
    elif path.is_file():
        clouds = map(_of_file, [path])
    else:
        raise InputError(f"{path}: no such file or folder")
    return (cloud._replace(points=validate_points(cloud.points, cloud.path)) for cloud in clouds)


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
        lines = [f"{len(self.boxes)} objects"]
        for box in self.boxes:
            place = f"at ({box.x:.1f}, {box.y:.1f}, {box.z:.1f}) m, yaw {box.yaw:.2f} rad"
            size = f"{box.length:.1f} x {box.width:.1f} x {box.height:.1f} m"
            lines.append(f"{box.label:<11}{box.score:.2f}  {place}, {size}")
        return lines


def boxes_to_rows(boxes: Boxes) -> tuple[ObjectFound, ...]:
    """Return the boxes as records, one per box; a score that is not known is 1."""
    scores = boxes.score if boxes.score is not None else np.ones(len(boxes))
    rows = zip(boxes.label.tolist(), scores.tolist(), boxes.array().tolist(), strict=True)
    return tuple(ObjectFound(label, score, *row) for label, score, row in rows)


def rows_to_boxes(rows: Sequence[ObjectFound]) -> Boxes:
    """Return the records as boxes: the inverse of `boxes_to_rows`."""
    array = np.array([(b.x, b.y, b.z, b.length, b.width, b.height, b.yaw) for b in rows]).reshape(-1, 7)
    return Boxes.from_array(array, [row.label for row in rows], [row.score for row in rows])


def _of_file(path: Path) -> Cloud:
    return Cloud(path, read_points(path), partial(view_beside, path))


def _recorded(folder: Path, frames: Sequence[int] | None) -> Iterator[Cloud]:
    dataset = Dataset.open(folder)
    for i in dataset.numbers(frames):
        frame = dataset.frame(i)
        lidar = choose_lidar(frame)
        yield Cloud(folder / frame.key, frame.lidar[lidar], partial(recorded_view, dataset, i, lidar))
