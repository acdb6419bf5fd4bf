"""Point clouds from what a user names, and boxes as JSON knows them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.kitti import read_points
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.perception.objects.samples import checked_points, only_lidar

FIELDS = ("x", "y", "z", "length", "width", "height", "yaw")


def point_clouds(path: Path) -> Iterator[tuple[Path, NDArray[np.float32]]]:
    """Yield the point clouds of a KITTI .bin file, a folder of them, or a dataset folder, each with its own path.

    Raises `InputError` for anything else, and for a cloud that is empty, truncated or not of finite numbers.
    """
    if (path / MANIFEST).is_file():
        clouds = _recorded(path)
    elif path.is_dir():
        files = sorted(path.glob("*.bin"))
        if not files:
            raise InputError(f"{path}: neither a dataset nor a folder with .bin files")
        clouds = ((file, read_points(file)) for file in files)
    elif path.is_file():
        clouds = iter([(path, read_points(path))])
    else:
        raise InputError(f"{path}: no such file or folder")
    return ((origin, checked_points(points, origin)) for origin, points in clouds)


def box_rows(boxes: Boxes) -> list[dict[str, Any]]:
    """Return one dictionary per box: class, score, centre, size [m] and yaw [rad], LiDAR frame."""
    scores = boxes.score if boxes.score is not None else np.ones(len(boxes))
    return [
        {"class": str(label), "score": float(score)} | {name: float(v) for name, v in zip(FIELDS, row, strict=True)}
        for row, label, score in zip(boxes.array(), boxes.label, scores, strict=True)
    ]


def _recorded(folder: Path) -> Iterator[tuple[Path, NDArray[np.float32]]]:
    dataset = Dataset.open(folder)
    for i in range(len(dataset)):
        frame = dataset.frame(i)
        yield folder / frame.key, frame.lidar[only_lidar(frame)]
