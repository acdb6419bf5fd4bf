"""Samples of the road task: images with a class for every pixel, their messages, and augmentation.

Augmentation is by windows at random scales, mostly of the part of the image where the road is, mirroring, brightness
and saturation.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from flcav.arrays import Bytes
from flcav.config import InputError
from flcav.dataset.payloads import encode_png, open_image
from flcav.dataset.road_labels import IGNORED, check_road_labels, label_road
from flcav.dataset.store import Dataset
from flcav.network.ledger import pack_arrays, unpack_arrays
from flcav.perception.images import Picture, check_picture, pack_pictures, recoloured, resize_picture, unpack_pictures
from flcav.perception.road.model import RoadConfig

KEPT_BYTES = 2_000_000_000  # [B] of images and labels cached in memory


@dataclass(frozen=True)
class Sample:
    """A labelled image."""

    picture: Picture
    classes: Bytes  # (H, W) index in `ROAD_CLASSES`, or IGNORED


class RecordedRoads(Sequence[Sample]):
    """The labelled images of all cameras in frames of a dataset (None: all), read and labelled on access, then cached.

    Raises `InputError` where no frame has a camera, and as `check_road_labels` does.
    """

    def __init__(self, data: Dataset, frames: Sequence[int] | None = None) -> None:
        self._data = data
        self._of = list_pictures(data, data.numbers(frames))
        self._kept: dict[int, Sample] = {}
        self._kept_bytes = 0

    def __len__(self) -> int:
        return len(self._of)

    def __getitem__(self, index: Any) -> Any:
        if index in self._kept:
            return self._kept[index]
        number, camera = self._of[index]
        picture = read_recorded_picture(self._data, number, camera)
        sample = Sample(picture, label_road(self._data, number, camera).classes)
        size = picture.nbytes + sample.classes.nbytes
        if self._kept_bytes + size <= KEPT_BYTES:
            self._kept[index] = sample
            self._kept_bytes += size
        return sample


def list_pictures(data: Dataset, numbers: Sequence[int]) -> list[tuple[int, str]]:
    """Return frame number and camera of every image; raises `InputError` without one, and as `check_road_labels`."""
    pairs = [(number, camera) for number in numbers for camera in data.cameras(number)]
    if not pairs:
        raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")
    check_road_labels(data)
    return pairs


def read_recorded_picture(data: Dataset, number: int, camera: str) -> Picture:
    """Return a recorded image; raises `InputError` as `check_picture` does."""
    return check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {data.name(number)}/{camera}")


def pack_roads(data: Dataset, number: int) -> bytes:
    """Return the message of a frame: its images as recorded, and their classes as PNG files."""
    arrays = dict(pack_pictures(data, number))
    for camera in data.cameras(number):
        classes = label_road(data, number, camera).classes
        arrays[f"{camera}.classes"] = np.frombuffer(encode_png(classes), np.uint8)
    return pack_arrays(arrays)


def unpack_roads(message: bytes) -> list[Sample]:
    """Return the samples in a message of `pack_roads`."""
    arrays = unpack_arrays(message)
    return [
        Sample(picture, np.asarray(open_image(io.BytesIO(arrays[f"{camera}.classes"].tobytes()))))
        for camera, picture in unpack_pictures(arrays).items()
    ]


GREY = 114  # padding value outside an image
SCALE = (0.8, 1.4)  # range of the scale of a window
LOW = 0.8  # probability that a window ends near the lower edge of the image, where the road is
GAIN, SATURATION = (0.6, 1.4), (0.5, 1.5)  # ranges of the factors of brightness and of saturation


def draw_window(sample: Sample, config: RoadConfig, rng: np.random.Generator) -> Sample:
    """Return an augmented window of `config.window_px` of the sample."""
    width, height = config.window_px
    across, down = (round(side / rng.uniform(*SCALE)) for side in (width, height))
    rows, columns = sample.classes.shape
    left = int(rng.integers(min(columns - across, 0), max(columns - across, 0) + 1))
    lowest = rows - down
    top = int(rng.integers(min(lowest, 0), max(lowest, 0) + 1))
    if rng.random() < LOW:
        top = max(top, lowest - down // 4)
    picture = np.full((down, across, 3), GREY, np.uint8)
    classes = np.full((down, across), IGNORED, np.uint8)
    y0, y1, x0, x1 = max(top, 0), min(top + down, rows), max(left, 0), min(left + across, columns)
    inside = np.s_[y0 - top : y1 - top, x0 - left : x1 - left]
    picture[inside], classes[inside] = sample.picture[y0:y1, x0:x1], sample.classes[y0:y1, x0:x1]
    small = np.asarray(Image.fromarray(classes).resize((width, height), Image.Resampling.NEAREST))
    seen = recoloured(resize_picture(picture, width, height), rng.uniform(*GAIN), rng.uniform(*SATURATION))
    if rng.random() < 0.5:
        seen, small = np.ascontiguousarray(seen[:, ::-1]), np.ascontiguousarray(small[:, ::-1])
    return Sample(seen, small)
