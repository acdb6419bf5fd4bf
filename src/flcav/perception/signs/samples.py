"""What the detector learns from: pictures, the boxes to find, the places to leave out of the loss."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.rectangles import CLASSES, rectangles
from flcav.dataset.store import Dataset
from flcav.perception.images import Picture, checked_picture
from flcav.perception.signs.config import SignsConfig
from flcav.sensors.frame import Frame

KEPT_BYTES = 3_000_000_000  # of pictures that stay in memory once they are read


@dataclass(frozen=True)
class Sample:
    """One labelled picture; boxes are x1 y1 x2 y2 [px] from its upper left corner."""

    picture: Picture
    boxes: NDArray[np.float64]  # (N, 4) to be found
    label: NDArray[np.int64]  # (N,) number of the class
    ignore: NDArray[np.float64]  # (K, 4) neither to be found nor to be kept apart


class RecordedPictures(Sequence[Sample]):
    """Every camera's pictures in frames of a dataset with their ground truth.

    They are read when asked for, and stay in memory as long as they take no more than `KEPT_BYTES` together.
    Raises `InputError` where no frame has a camera.
    """

    def __init__(self, data: Dataset, config: SignsConfig, frames: Sequence[int] | None = None) -> None:
        self._data, self._config = data, config
        self._of = [(number, camera) for number in data.numbers(frames) for camera in data.frame(number).images]
        if not self._of:
            raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")
        self._kept: dict[int, Sample] = {}
        self._kept_bytes = 0

    def __len__(self) -> int:
        return len(self._of)

    def __getitem__(self, index: Any) -> Any:
        if index in self._kept:
            return self._kept[index]
        number, camera = self._of[index]
        picture = self._data.plane(number, camera, "rgb")
        frame = self._data.frame(number)
        sample = sample_of(frame, camera, checked_picture(picture, f"{self._data.folder} {frame.key}"), self._config)
        if self._kept_bytes + picture.nbytes <= KEPT_BYTES:
            self._kept[index] = sample
            self._kept_bytes += picture.nbytes
        return sample

    def scene(self, index: int) -> str:
        """Return the scene of a picture."""
        return self._data.keys[self._of[index][0]].scene


def sample_of(frame: Frame, camera: str, picture: Picture, config: SignsConfig) -> Sample:
    """Return a camera's picture with its signs and lights.

    Those smaller than `config.smallest_px` are ignored, and so are those that the picture's edge cuts off: what a lamp
    shows may lie outside.
    """
    shown = rectangles(frame, camera, "signs", min_pixels=1)
    names = [CLASSES["signs"][number] for number in shown.label]
    known = np.array([name in config.classes for name in names], dtype=bool)
    label = np.array([config.classes.index(name) for name, ok in zip(names, known) if ok], dtype=np.int64)
    box = shown.box[known]
    height, width = picture.shape[:2]
    wanted = wanted_boxes(box, (width, height), config)
    return Sample(picture, box[wanted], label[wanted], box[~wanted])


def wanted_boxes(box: NDArray[np.float64], size: tuple[int, int], config: SignsConfig) -> NDArray[np.bool_]:
    """Return which boxes (N, 4) are to be found in a picture of `size` (width, height) [px]: whole and large enough."""
    whole = (box[:, :2] > 0).all(1) & (box[:, 2:] < size).all(1)
    return whole & (size_px(box) >= config.smallest_px)


def size_px(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) the root of each box's area."""
    return np.sqrt((boxes[:, 2:] - boxes[:, :2]).clip(min=0).prod(1))
