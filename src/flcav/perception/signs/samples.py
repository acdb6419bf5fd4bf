"""Samples of the sign task: images with target boxes, and ignored boxes that are left out of the loss."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.rectangles import CLASSES, select_rectangles
from flcav.dataset.store import Dataset
from flcav.perception.images import Picture
from flcav.perception.signs.background import check_stands, picture_reader
from flcav.perception.signs.config import SignsConfig
from flcav.sensors.frame import Frame

KEPT_BYTES = 3_000_000_000  # [B] of images cached in memory


@dataclass(frozen=True)
class Sample:
    """One labelled image; boxes are x1 y1 x2 y2 [px] from its upper left corner."""

    picture: Picture
    boxes: NDArray[np.float64]  # (N, 4) targets
    label: NDArray[np.int64]  # (N,) index of the class
    ignore: NDArray[np.float64]  # (K, 4) neither targets nor background


class RecordedPictures(Sequence[Sample]):
    """The labelled images of all cameras in frames of a dataset (None: all).

    Images are read on access and cached up to `KEPT_BYTES`. Raises `InputError` if no frame has a camera, and for
    frames of vehicles if the network sees pictures beside their background.
    """

    def __init__(self, data: Dataset, config: SignsConfig, frames: Sequence[int] | None = None) -> None:
        data.check_labelled("signs" if config.labels == "signs" else "objects")
        self._data, self._config, self._read = data, config, picture_reader(data, config.background)
        numbers = data.numbers(frames)
        if config.background:
            check_stands(data, numbers)
        self._of = [(number, camera) for number in numbers for camera in data.frame(number).images]
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
        picture = self._read(number, camera)
        sample = sample_from_frame(self._data.frame(number), camera, picture, self._config)
        if self._kept_bytes + picture.nbytes <= KEPT_BYTES:
            self._kept[index] = sample
            self._kept_bytes += picture.nbytes
        return sample

    def scene(self, index: int) -> str:
        """Return the scene of image `index`."""
        return self._data.keys[self._of[index][0]].scene


def sample_from_frame(frame: Frame, camera: str, picture: Picture, config: SignsConfig) -> Sample:
    """Return a camera's image with the boxes of its signs and lights, or of its actors, as `config.labels` says.

    Boxes smaller than `config.smallest_px` are ignored, and so are signs cut off by the image's edge: a lamp may lie
    outside.
    """
    shown = select_rectangles(frame, camera, config.labels, min_pixels=1)
    names = [CLASSES[config.labels][number] for number in shown.label]
    known = np.array([name in config.classes for name in names], dtype=bool)
    label = np.array([config.classes.index(name) for name, ok in zip(names, known) if ok], dtype=np.int64)
    box = shown.box[known]
    height, width = picture.shape[:2]
    wanted = find_targets(box, (width, height), config)
    return Sample(picture, box[wanted], label[wanted], box[~wanted])


def find_targets(box: NDArray[np.float64], size: tuple[int, int], config: SignsConfig) -> NDArray[np.bool_]:
    """Return (N,) which boxes (N, 4) are targets in an image of `size` (width, height) [px].

    They are large enough, and those of signs are whole.
    """
    whole = (box[:, :2] > 0).all(1) & (box[:, 2:] < size).all(1)
    return (whole | (config.labels != "signs")) & (size_px(box) >= config.smallest_px)


def size_px(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the size (N,) of boxes (N, 4): the square root of the area [px]."""
    return np.sqrt((boxes[:, 2:] - boxes[:, :2]).clip(min=0).prod(1))
