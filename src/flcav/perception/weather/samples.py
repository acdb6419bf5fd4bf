"""Samples of the weather task: images of 32 x 32 pixels with their class of weather."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.images import Picture, read_recorded, resize_picture
from flcav.perception.weather.model import SIDE
from flcav.world.weather import Weather, classify_weather


@dataclass(frozen=True)
class Sample:
    """One labelled image."""

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
    found = [
        Sample(picture, classes.index(name), scene) for (picture, _, scene), name in zip(seen, names) if name in classes
    ]
    if not found:
        raise InputError(f"{data.folder}: no picture in any of the weathers {', '.join(classes)}")
    return found


@lru_cache(maxsize=4)  # since a validation reads the same images after every epoch
def _reduced(data: Dataset, frames: tuple[int, ...] | None) -> list[tuple[Picture, Weather | None, str]]:
    return [(reduce_picture(rgb), frame.weather, frame.scene) for frame, _, rgb in read_recorded(data, frames)]


def reduce_picture(picture: Picture) -> Picture:
    """Return the whole image resized to 32 x 32 pixels, whatever its aspect ratio."""
    return resize_picture(picture, SIDE, SIDE)


def stack_pictures(pictures: list[Picture]) -> NDArray[np.float32]:
    """Return images (32, 32, 3) uint8 as one array (B, 3, 32, 32) in [-1, 1]."""
    return np.stack(pictures).transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1
