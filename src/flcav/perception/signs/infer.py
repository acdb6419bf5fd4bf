"""Inference on images of files, folders and datasets: findings with the detected signs and traffic lights."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.perception.images import Picture, read_pictures, read_recorded
from flcav.perception.marks import PictureBoxes
from flcav.perception.signs.background import check_stands, compare_with_background, learn_picture_background
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.predict import boxes_found, detect
from flcav.perception.task import Finding


def detect_signs(
    network: SignDetector, path: Path, threshold: float, frames: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield the detections of score `threshold` or more in each image at `path`, by falling score.

    Raises `InputError` as `flcav.perception.images.read_pictures` does. A network of backgrounds finds in pictures of a
    dataset's poles alone; it raises `InputError` for files, and for frames of vehicles.
    """
    for origin, rgb, seen in _read(network, path, frames):
        found = detect(network, seen, threshold=threshold)
        names = np.array(network.config.classes)[found.label]
        marks = (PictureBoxes(found.box, names, found.score),)
        yield Finding(origin, rgb, boxes_found(found, network.config.classes), marks)


def _read(network: SignDetector, path: Path, frames: Sequence[int] | None) -> Iterator[tuple[Path, Picture, Picture]]:
    """Yield path and image, and the image as the network sees it."""
    if not network.config.background:
        yield from ((origin, rgb, rgb) for origin, rgb in read_pictures(path, frames))
        return
    if not (path / MANIFEST).is_file():
        raise InputError(f"{path}: this network sees pictures of poles beside their background; a dataset is wanted")
    data = Dataset.open(path)
    check_stands(data, data.numbers(frames))
    for frame, camera, rgb in read_recorded(data, frames):
        behind = learn_picture_background(data, frame.agent, camera)
        yield path / f"{frame.key}/{camera}", rgb, compare_with_background(rgb, behind)
