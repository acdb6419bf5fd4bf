"""Inference on images of files, folders and datasets: findings with the detected signs and traffic lights."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.perception.images import read_pictures
from flcav.perception.marks import PictureBoxes
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.predict import boxes_found, detect
from flcav.perception.task import Finding


def detect_signs(
    network: SignDetector, path: Path, threshold: float, frames: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield the detections of score `threshold` or more in each image at `path`, by falling score.

    Raises `InputError` as `flcav.perception.images.read_pictures` does, and for a network of backgrounds, which sees
    pictures of datasets alone: `flcav evaluate`.
    """
    if network.config.background:
        raise InputError(f"{path}: this network sees pictures beside their background; flcav evaluate signs learns it")
    for origin, rgb in read_pictures(path, frames):
        found = detect(network, rgb, threshold=threshold)
        names = np.array(network.config.classes)[found.label]
        marks = (PictureBoxes(found.box, names, found.score),)
        yield Finding(origin, rgb, boxes_found(found, network.config.classes), marks)
