"""Samples of the weather task: images of 32 x 32 pixels with their class, their augmentation, and their messages."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flcav.arrays import Array32
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.images import Picture, pack_pictures, read_recorded, resize_picture, unpack_pictures
from flcav.perception.weather.model import SIDE
from flcav.world.weather import Weather, classify_weather


@dataclass(frozen=True)
class Sample:
    """A labelled image."""

    picture: Picture  # (32, 32, 3)
    label: int  # index of the class
    scene: str = ""  # name of its scene


def label_pictures(
    data: Dataset,
    classes: Sequence[str],
    frames: Sequence[int] | None = None,
    *,
    named: Callable[[Weather], str | None] = classify_weather,
) -> list[Sample]:
    """Return the images of all cameras in frames of a dataset (None: all), reduced to 32 x 32 pixels, with their class.

    `named` maps a frame's weather to the name of its class; images of no class, or of one not in `classes`, are left
    out. Raises `InputError` if there are no images, if no weather was recorded, or if no image is in `classes`.
    """
    seen = _reduced(data, None if frames is None else tuple(frames))
    if all(weather is None for _, weather, _ in seen):
        raise InputError(f"{data.folder}: the weather was not recorded, which 'weather' needs")
    names = [None if weather is None else named(weather) for _, weather, _ in seen]
    samples = [
        Sample(picture, classes.index(name), scene) for (picture, _, scene), name in zip(seen, names) if name in classes
    ]
    if not samples:
        raise InputError(f"{data.folder}: no picture in any of the weathers {', '.join(classes)}")
    return samples


@lru_cache(maxsize=4)  # since a validation reads the same images after every epoch
def _reduced(data: Dataset, frames: tuple[int, ...] | None) -> list[tuple[Picture, Weather | None, str]]:
    return [(reduce_picture(rgb), frame.weather, frame.scene) for frame, _, rgb in read_recorded(data, frames)]


def reduce_picture(picture: Picture) -> Picture:
    """Return the whole image resized to 32 x 32 pixels, whatever its aspect ratio."""
    return resize_picture(picture, SIDE, SIDE)


def stack_pictures(pictures: list[Picture]) -> Array32:
    """Return images (32, 32, 3) uint8 as one array (B, 3, 32, 32) in [-1, 1]."""
    return np.stack(pictures).transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1


SHIFT_PX = 3  # largest shift of augmentation
GAIN, GAMMA, SATURATION = 0.05, 0.2, 0.25  # largest absolute logarithms of augmentation's random factors


def augment_picture(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with random mirroring, a random shift of up to 3 pixels, and random gain, gamma and saturation.

    The last three imitate differences between cameras; they are small, since the light itself shows the weather.
    """
    picture = sample.picture[:, ::-1] if rng.random() < 0.5 else sample.picture
    padded = np.pad(picture, ((SHIFT_PX, SHIFT_PX), (SHIFT_PX, SHIFT_PX), (0, 0)), mode="edge")
    top, left = rng.integers(0, 2 * SHIFT_PX + 1, 2)
    gain, gamma, saturation = np.exp(rng.uniform(-1, 1, 3) * (GAIN, GAMMA, SATURATION))
    lit = gain * (padded[top : top + SIDE, left : left + SIDE] / np.float32(255)) ** gamma
    grey = lit.mean(axis=2, keepdims=True)
    shown = np.clip(255 * (grey + saturation * (lit - grey)), 0, 255)
    return Sample(shown.astype(np.uint8), sample.label, sample.scene)


def pack_pictures_and_weather(
    data: Dataset, number: int, named: Callable[[Weather], str | None] = classify_weather
) -> bytes:
    """Return the message of a frame: its images, the class of its weather, and its scene."""
    weather = data.frame(number).weather
    label = None if weather is None else named(weather)
    return pack_arrays({"label": from_names([label or "", data.keys[number].scene]), **pack_pictures(data, number)})


def unpack_frame(message: bytes, classes: Sequence[str]) -> list[Sample]:
    """Return the samples in a message: those of `label_pictures`, none for a weather of no class."""
    arrays = unpack_arrays(message)
    label, scene = map(str, to_names(arrays["label"]))
    if label not in classes:
        return []
    return [
        Sample(reduce_picture(picture), classes.index(label), scene) for picture in unpack_pictures(arrays).values()
    ]
