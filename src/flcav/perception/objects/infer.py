"""Inference on point clouds of files, folders and datasets: findings with the detected objects."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.sweeps import list_sweeps, read_cloud_file
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.perception.foreground import frame_reader
from flcav.perception.images import CameraView, recorded_view, view_beside
from flcav.perception.marks import CloudBoxes
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import ObjectsFound, boxes_to_rows, detect_moved
from flcav.perception.objects.samples import validate_points
from flcav.perception.objects.truth import choose_lidar, network_from_lidar
from flcav.perception.task import Finding


class InputCloud(NamedTuple):
    """A point cloud to detect objects in, LiDAR frame."""

    path: Path  # of the file; of a dataset, folder / key of the frame
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1]
    move: NDArray[np.float64] | None  # (4, 4) brings it to the frame that the network was trained in; None: it is there
    view: Callable[[], CameraView | None]  # reads the view of a camera with the same direction, None without one


def detect_objects(
    network: Second, path: Path, threshold: float, frames: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield the objects of score `threshold` or more in each point cloud of `path`.

    path: a point cloud's file, see `read_cloud_file`, a folder of them, or a dataset folder, of which `frames` (None:
    all). Raises `InputError` as `read_point_clouds` does.
    """
    for cloud in read_point_clouds(path, frames, network.config):
        (found,) = detect_moved(network, [cloud.points], [cloud.move], score_threshold=threshold)
        yield Finding(cloud.path, cloud.points, ObjectsFound(boxes_to_rows(found)), (CloudBoxes(found),), cloud.view)


def read_point_clouds(path: Path, frames: Sequence[int] | None, config: SecondConfig) -> Iterator[InputCloud]:
    """Yield the point clouds of a file, of a folder of them, or of `frames` (None: all) of a dataset folder.

    Those of a dataset are as a network of `config` sees them. Raises `InputError` where `path` is none of these, a
    frame has no LiDAR, or a cloud is empty, truncated, of an unknown layout or not of numbers in range.
    """
    if (path / MANIFEST).is_file():
        clouds = _recorded(path, frames, config)
    elif path.is_dir():
        files = list_sweeps(path)
        if not files:
            raise InputError(f"{path}: neither a dataset nor a folder with .bin or .pcd files")
        clouds = map(_of_file, files)
    elif path.is_file():
        clouds = map(_of_file, [path])
    else:
        raise InputError(f"{path}: no such file or folder")
    return clouds


def _of_file(path: Path) -> InputCloud:
    return InputCloud(path, validate_points(read_cloud_file(path), path), None, partial(view_beside, path))


def _recorded(folder: Path, frames: Sequence[int] | None, config: SecondConfig) -> Iterator[InputCloud]:
    dataset = Dataset.open(folder)
    read = frame_reader(dataset, config.foreground)
    for i in dataset.numbers(frames):
        frame = read(i)
        lidar, origin = choose_lidar(frame), folder / frame.key
        points = frame.lidar[lidar]
        if not config.foreground:  # a street may be empty before its background
            validate_points(points, origin)
        yield InputCloud(origin, points, network_from_lidar(frame, config), partial(recorded_view, dataset, i, lidar))
