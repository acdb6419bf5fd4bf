"""Augmentation of images of signs: random crops and scales, mosaics, brightness and saturation; no mirroring.

The mosaic is that of Bochkovskiy et al., "YOLOv4", 2020, sec. 3.3, of crops ("windows") instead of whole images made
smaller: signs are few and small, so most windows are drawn around a sign. Small windows around signs show the network
many digits at a low cost. Each window but the first looks for a sign of a class drawn at random, so that rare classes
(amber lasts seconds of a minute) are seen as often as others.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from flcav.perception.images import recoloured, resize_picture
from flcav.perception.signs.config import SignsConfig
from flcav.perception.signs.samples import Sample, size_px

GREY = 114  # padding value outside an image
SHARES = (0.15, 0.25, 0.3, 0.3)  # probabilities of a single window and of a mosaic of 2 x 2, 3 x 3, 4 x 4 windows
PART_PX = 32  # approximate least height of a mosaic's windows
UNEVEN = 0.3  # largest offset of a border within a mosaic, as a share of a window's side
AROUND_A_SIGN = 0.8  # probability that a window is placed around a sign, if the image has any
SCALE = (0.6, 2.0)  # range of the scale of a window
WHOLE = 0.8  # least share of a box inside the window for a target; otherwise the lamp may be cut off
LOOKS = 12  # number of images searched for a sign of a class
GAIN, SATURATION = (0.7, 1.3), (0.6, 1.4)  # ranges of the factors of brightness and of saturation


def draw(samples: Sequence[Sample], index: int, config: SignsConfig, rng: np.random.Generator) -> Sample:
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
    """Return a random sample, with a sign of class `label` if one is among `LOOKS` samples."""
    looked = (samples[int(number)] for number in rng.integers(0, len(samples), LOOKS))
    sample = next(looked)
    while label not in sample.label and (other := next(looked, None)):
        sample = other
    return sample


def join_mosaic(parts: Sequence[tuple[Sample, int, int]], width: int, height: int) -> Sample:
    """Return the mosaic of parts at (x, y) [px] of their upper left corners; the rest is grey."""
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

    Padding outside the image is grey. Boxes of which less than the share `WHOLE` remains, or that become smaller than
    `config.smallest_px`, become ignored.
    """
    x, y, across, down = part
    canvas = np.full((down, across, 3), GREY, np.uint8)
    height, width = sample.picture.shape[:2]
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + across, width), min(y + down, height)
    canvas[y0 - y : y1 - y, x0 - x : x1 - x] = sample.picture[y0:y1, x0:x1]
    factor = np.array([size[0] / across, size[1] / down] * 2)

    def moved(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        clipped = np.clip(boxes - [x, y, x, y], 0, [across, down, across, down])
        return clipped * factor

    boxes, ignore = moved(sample.boxes), moved(sample.ignore)
    before = size_px(sample.boxes) ** 2 * factor[:2].prod()
    left = size_px(boxes) ** 2
    found = (left >= WHOLE * before) & (size_px(boxes) >= config.smallest_px)
    ignore = np.concatenate((ignore[size_px(ignore) > 0], boxes[~found & (left > 0)]))
    return Sample(resize_picture(canvas, *size), boxes[found], sample.label[found], ignore)


def _in_other_colours(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with random brightness and saturation; hues are kept, since they distinguish lights."""
    gain, saturation = rng.uniform(*GAIN), rng.uniform(*SATURATION)
    return replace(sample, picture=recoloured(sample.picture, gain, saturation))
