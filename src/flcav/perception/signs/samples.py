"""Samples of the sign task: images with target and ignored boxes, their messages, backgrounds and augmentation.

A network of backgrounds sees the pictures of a fixed camera together with the static background. That is the median of
the camera's pictures in the same dataset, as the background of a roadside LiDAR is learned from its sweeps.

Augmentation is by random crops and scales, mosaics, brightness and saturation; there is no mirroring. The mosaic is
that of Bochkovskiy et al., "YOLOv4", 2020, sec. 3.3, but of crops ("windows") instead of whole images made smaller:
signs are few and small, so that most windows are drawn around a sign. Small windows around signs show the network many
digits at a low cost. Every window but the first looks for a sign of a class drawn at random, so that rare classes
(amber lasts seconds of a minute) are seen as often as others.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from flcav.arrays import Array, Bytes, Ints, Mask
from flcav.config import InputError
from flcav.dataset.rectangles import CLASSES, select_rectangles
from flcav.dataset.store import Dataset
from flcav.network.ledger import pack_arrays, unpack_arrays
from flcav.perception.agents import POLE, kind_of
from flcav.perception.images import Picture, check_picture, pack_pictures, recoloured, resize_picture, unpack_pictures
from flcav.perception.signs.model import SignsConfig
from flcav.sensors.frame import Frame

KEPT_BYTES = 3_000_000_000  # [B] of images cached in memory


@dataclass(frozen=True)
class Sample:
    """A labelled image; boxes are x1 y1 x2 y2 [px] from its upper left corner."""

    picture: Picture
    boxes: Array  # (N, 4) targets
    label: Ints  # (N,) index of the class
    ignore: Array  # (K, 4) neither targets nor background


class RecordedPictures(Sequence[Sample]):
    """The labelled images of all cameras in frames of a dataset (None: all).

    Images are read on access and cached up to `KEPT_BYTES`. Raises `InputError` where no frame has a camera, and for
    frames of vehicles if the network needs backgrounds.
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
        sample = label_picture(self._data.frame(number), camera, picture, self._config)
        if self._kept_bytes + picture.nbytes <= KEPT_BYTES:
            self._kept[index] = sample
            self._kept_bytes += picture.nbytes
        return sample

    def scene(self, index: int) -> str:
        """Return the scene of image `index`."""
        return self._data.keys[self._of[index][0]].scene


def label_picture(frame: Frame, camera: str, picture: Picture, config: SignsConfig) -> Sample:
    """Return a camera's image with the boxes of its signs and lights, or of its actors, as `config.labels` says.

    Boxes smaller than `config.smallest_px` are ignored, and so are signs cut off by the image's edge, whose lit lamp
    may be outside.
    """
    shown = select_rectangles(frame, camera, config.labels, min_pixels=1)
    names = [CLASSES[config.labels][number] for number in shown.label]
    known = np.array([name in config.classes for name in names], dtype=bool)
    label = np.array([config.classes.index(name) for name, ok in zip(names, known) if ok], dtype=np.int64)
    box = shown.box[known]
    height, width = picture.shape[:2]
    wanted = find_targets(box, (width, height), config)
    return Sample(picture, box[wanted], label[wanted], box[~wanted])


def find_targets(box: Array, size: tuple[int, int], config: SignsConfig) -> Mask:
    """Return the mask (N,) of boxes (N, 4) that are targets in an image of `size` (width, height) [px].

    They are large enough and, if they are signs, not cut off.
    """
    whole = (box[:, :2] > 0).all(1) & (box[:, 2:] < size).all(1)
    return (whole | (config.labels != "signs")) & (size_px(box) >= config.smallest_px)


def size_px(boxes: Array) -> Array:
    """Return the size (N,) of boxes (N, 4): the square root of the area [px]."""
    return np.sqrt((boxes[:, 2:] - boxes[:, :2]).clip(min=0).prod(1))


LEAST_PICTURES = 3  # pictures of a camera: the median of fewer shows moving objects, too
MOST_PICTURES = 40  # pictures per camera, evenly spread over the dataset, from which its background is learned
LUMA = np.array((0.299, 0.587, 0.114))  # ITU-R BT.601


def picture_reader(data: Dataset, background: bool) -> Callable[[int, str], Picture]:
    """Return the function that reads the picture of a frame, by number, and a camera as a network sees it.

    For a network of backgrounds (`background`) it is `compare_with_background`, for poles only. Raises `InputError` as
    `check_picture`, `check_stands` and `learn_picture_background` do.
    """

    def read(number: int, camera: str) -> Picture:
        rgb = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {data.name(number)}")
        if not background:
            return rgb
        check_stands(data, [number])
        return compare_with_background(rgb, learn_picture_background(data, data.keys[number].agent, camera))

    return read


def check_stands(data: Dataset, numbers: Iterable[int]) -> None:
    """Raise `InputError` unless the agents of all these frames are poles: a vehicle's camera has no background."""
    for agent in dict.fromkeys(data.keys[number].agent for number in numbers):
        if kind_of(agent) != POLE:
            raise InputError(
                f"{data.folder}: {agent} moves, and this network sees pictures of poles beside their background; "
                "choose them with --agents poles"
            )


def compare_with_background(picture: Picture, background: Picture) -> Picture:
    """Return (H, W, 3): luma of the picture, luma of the background, and the largest difference of a colour channel."""
    apart = np.abs(picture.astype(np.int16) - background).max(axis=2)
    return np.stack([picture @ LUMA, background @ LUMA, apart], axis=2).round().astype(np.uint8)


@lru_cache(maxsize=64)
def learn_picture_background(data: Dataset, agent: str, camera: str) -> Bytes:
    """Return the median (H, W, 3) of an agent's pictures by a camera in `data`.

    Raises `InputError` where there are fewer than `LEAST_PICTURES`.
    """
    numbers = [number for number in data.select(agents={agent}) if camera in data.cameras(number)]
    if len(numbers) < LEAST_PICTURES:
        raise InputError(
            f"{data.folder}: {agent} has {len(numbers)} picture{'s' * (len(numbers) != 1)} by {camera}, and this "
            f"network's background is learned from {LEAST_PICTURES} or more; record more scenes or spins"
        )
    chosen = numbers[:: -(-len(numbers) // MOST_PICTURES)]
    return np.median([data.plane(number, camera, "rgb") for number in chosen], axis=0).astype(np.uint8)


BOXES = ("boxes", "label", "ignore")  # fields of a sample, and names of arrays after the camera's


def pack_signs(data: Dataset, number: int, config: SignsConfig) -> bytes:
    """Return the message of a frame: its images with their boxes."""
    frame, arrays = data.frame(number), dict(pack_pictures(data, number))
    for camera in frame.images:
        picture = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {frame.key}")
        sample = label_picture(frame, camera, picture, config)
        arrays |= {f"{camera}.{field}": getattr(sample, field) for field in BOXES}
    return pack_arrays(arrays)


def unpack_signs(message: bytes) -> list[Sample]:
    """Return the samples in a message: those of `label_picture` for every camera."""
    arrays = unpack_arrays(message)
    return [
        Sample(picture, *(arrays[f"{camera}.{field}"] for field in BOXES))
        for camera, picture in unpack_pictures(arrays).items()
    ]


GREY = 114  # padding value outside an image
SHARES = (0.15, 0.25, 0.3, 0.3)  # probabilities of a single window and of a mosaic of 2 x 2, 3 x 3, 4 x 4 windows
PART_PX = 32  # approximate least height of a mosaic's windows
UNEVEN = 0.3  # largest offset of a border within a mosaic, as a share of a window's side
AROUND_A_SIGN = 0.8  # probability that a window is placed around a sign, if the image has any
SCALE = (0.6, 2.0)  # range of the scale of a window
WHOLE = 0.8  # least share of a box inside the window for a target; otherwise the lamp may be cut off
LOOKS = 12  # number of images searched for a sign of a class
GAIN, SATURATION = (0.7, 1.3), (0.6, 1.4)  # ranges of the factors of brightness and of saturation


def draw_mosaic(samples: Sequence[Sample], index: int, config: SignsConfig, rng: np.random.Generator) -> Sample:
    """Return an augmented sample of size `config.window_px`: a window of sample `index`, or a mosaic with others."""
    width, height = config.window_px
    across = max(min(int(rng.choice(len(SHARES), p=SHARES)) + 1, height // PART_PX), 1)
    columns, rows = _borders(width, across, rng), _borders(height, across, rng)
    parts = []
    for number, (row, column) in enumerate(product(range(across), repeat=2)):
        x, y = columns[column], rows[row]
        size = (columns[column + 1] - x, rows[row + 1] - y)
        wanted = int(rng.integers(len(config.classes))) if number else None
        sample = samples[index] if wanted is None else _one_with(wanted, samples, rng)
        parts.append((draw_window(sample, *size, config, rng, wanted), x, y))
    joined = join_mosaic(parts, width, height)
    return joined if config.background else _in_other_colours(joined, rng)


def _borders(length: int, parts: int, rng: np.random.Generator) -> list[int]:
    """Return the borders [px] of `parts` parts of a length with randomly shifted inner borders: parts + 1 values."""
    inner = (np.arange(1, parts) + rng.uniform(-UNEVEN, UNEVEN, parts - 1)) * length / parts
    return [0, *inner.astype(int).tolist(), length]


def _one_with(label: int, samples: Sequence[Sample], rng: np.random.Generator) -> Sample:
    """Return a random sample, with a sign of class `label` if one is found among `LOOKS` samples."""
    looked = (samples[int(number)] for number in rng.integers(0, len(samples), LOOKS))
    sample = next(looked)
    while label not in sample.label and (other := next(looked, None)):
        sample = other
    return sample


def join_mosaic(parts: Sequence[tuple[Sample, int, int]], width: int, height: int) -> Sample:
    """Return the mosaic of parts, given with x, y [px] of their upper left corners; the rest is grey."""
    picture = np.full((height, width, 3), GREY, np.uint8)
    for part, x, y in parts:
        picture[y : y + part.picture.shape[0], x : x + part.picture.shape[1]] = part.picture
    moves = [np.array([x, y, x, y]) for _, x, y in parts]
    boxes = np.concatenate([part.boxes + move for (part, *_), move in zip(parts, moves, strict=True)])
    ignore = np.concatenate([part.ignore + move for (part, *_), move in zip(parts, moves, strict=True)])
    return Sample(picture, boxes, np.concatenate([part.label for part, *_ in parts]), ignore)


def draw_window(
    sample: Sample,
    width: int,
    height: int,
    config: SignsConfig,
    rng: np.random.Generator,
    wanted: int | None = None,
) -> Sample:
    """Return a window of `width` x `height` pixels of the sample at a random scale and place, mostly around a sign.

    The sign is drawn at random, among those of class `wanted` if there are any.
    """
    scale = rng.uniform(*SCALE)
    size = np.array([width, height]) / scale
    full = np.array(sample.picture.shape[1::-1], dtype=float)
    if len(sample.boxes) and rng.random() < AROUND_A_SIGN:
        of_class = np.flatnonzero(sample.label == wanted)
        box = sample.boxes[rng.choice(of_class if len(of_class) else len(sample.boxes))]
        corner = (box[:2] + box[2:]) / 2 - rng.uniform(0.15, 0.85, 2) * size
    else:
        corner = rng.uniform(0, 1, 2) * (full - size)
    corner = np.where(size < full, np.clip(corner, 0, full - size), (full - size) / 2)
    x, y = np.round(corner).astype(int)
    across, down = np.maximum(np.round(size).astype(int), 1)
    return crop_sample(sample, (int(x), int(y), int(across), int(down)), (width, height), config)


def crop_sample(sample: Sample, part: tuple[int, int, int, int], size: tuple[int, int], config: SignsConfig) -> Sample:
    """Return the crop `part` (x, y, width, height) [px] of a sample, resized to `size` (width, height) [px].

    Padding outside the image is grey. Boxes that keep less than the share `WHOLE`, or become smaller than
    `config.smallest_px`, become ignored.
    """
    x, y, across, down = part
    canvas = np.full((down, across, 3), GREY, np.uint8)
    height, width = sample.picture.shape[:2]
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + across, width), min(y + down, height)
    canvas[y0 - y : y1 - y, x0 - x : x1 - x] = sample.picture[y0:y1, x0:x1]
    factor = np.array([size[0] / across, size[1] / down] * 2)

    def moved(boxes: Array) -> Array:
        clipped = np.clip(boxes - [x, y, x, y], 0, [across, down, across, down])
        return clipped * factor

    boxes = moved(sample.boxes)
    ignore = moved(sample.ignore)
    before = size_px(sample.boxes) ** 2 * factor[:2].prod()
    left = size_px(boxes) ** 2
    kept = (left >= WHOLE * before) & (size_px(boxes) >= config.smallest_px)
    ignore = np.concatenate((ignore[size_px(ignore) > 0], boxes[~kept & (left > 0)]))
    return Sample(resize_picture(canvas, *size), boxes[kept], sample.label[kept], ignore)


def _in_other_colours(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with random brightness and saturation; hues are kept, since they distinguish lights."""
    gain, saturation = rng.uniform(*GAIN), rng.uniform(*SATURATION)
    return replace(sample, picture=recoloured(sample.picture, gain, saturation))
