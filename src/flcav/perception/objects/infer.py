"""Point clouds from what a user names, and boxes as JSON knows them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.kitti import read_points
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.perception.camera_view import CameraView, recorded_view, view_beside
from flcav.perception.objects.samples import checked_points
from flcav.perception.objects.truth import only_lidar
from flcav.perception.task import of_frames

FIELDS = ("x", "y", "z", "length", "width", "height", "yaw")


class Cloud(NamedTuple):
    """A point cloud to look into."""

    path: Path  # its own
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1]
    view: Callable[[], CameraView | None]  # of a camera that looks the same way, read when asked for


def point_clouds(path: Path, frames: Sequence[int] | None = None) -> Iterator[Cloud]:
    """Yield the point clouds of a KITTI .bin file, a folder of them, or `frames` of a dataset folder (None: all).

    Raises `InputError` for anything else, and for a cloud that is empty, truncated or not of finite numbers.
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
    return (cloud._replace(points=checked_points(cloud.points, cloud.path)) for cloud in clouds)


def box_rows(boxes: Boxes) -> list[dict[str, Any]]:
    """Return one dictionary per box: class, score, centre, size [m] and yaw [rad], LiDAR frame."""
    scores = boxes.score if boxes.score is not None else np.ones(len(boxes))
    return [
        {"class": str(label), "score": float(score)} | {name: float(v) for name, v in zip(FIELDS, row, strict=True)}
        for row, label, score in zip(boxes.array(), boxes.label, scores, strict=True)
    ]


def boxes_of_rows(rows: Sequence[Mapping[str, Any]]) -> Boxes:
    """Return the boxes that `box_rows` made rows of."""
    array = np.array([[row[name] for name in FIELDS] for row in rows]).reshape(-1, len(FIELDS))
    return Boxes.from_array(array, [row["class"] for row in rows], [row["score"] for row in rows])


def _of_file(path: Path) -> Cloud:
    return Cloud(path, read_points(path), partial(view_beside, path))


def _recorded(folder: Path, frames: Sequence[int] | None) -> Iterator[Cloud]:
    dataset = Dataset.open(folder)
    for i in of_frames(dataset, frames):
        frame = dataset.frame(i)
        lidar = only_lidar(frame)
        yield Cloud(folder / frame.key, frame.lidar[lidar], partial(recorded_view, dataset, i, lidar))
