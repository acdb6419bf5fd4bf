"""What the classifier learns from: small pictures and their weather."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.images import Picture, recorded, resized
from flcav.perception.weather.model import SIDE
from flcav.world.weather import Weather, weather_class

SHIFT_PX, GAIN = 3, 0.05  # the most that augmentation moves a picture, and brightens or darkens it


@dataclass(frozen=True)
class Sample:
    """One labelled picture."""

    picture: Picture  # (32, 32, 3)
    label: int  # index of the class
    scene: str = ""


def labelled(
    data: Dataset,
    classes: Sequence[str],
    frames: Sequence[int] | None = None,
    *,
    named: Callable[[Weather], str | None] = weather_class,
) -> list[Sample]:
    """Return every camera's pictures, small enough to be kept, with the class that `named` finds in their weather.

    Those of no class are left out. Raises `InputError` where there are no pictures, no record of the weather, or none
    of `classes`.
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


@lru_cache(maxsize=4)  # a validation looks at the same pictures after every epoch
def _reduced(data: Dataset, frames: tuple[int, ...] | None) -> list[tuple[Picture, Weather | None, str]]:
    return [(small(rgb), frame.weather, frame.scene) for frame, _, rgb in recorded(data, frames)]


def small(picture: Picture) -> Picture:
    """Return a picture as the network sees it: all of it, squeezed to 32 x 32 pixels."""
    return resized(picture, SIDE, SIDE)


def augment(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample mirrored in half of the cases, moved by up to 3 pixels, up to 5 % brighter or darker.

    The light itself tells the weather, so that no more than the camera's own gain is varied.
    """
    picture = sample.picture[:, ::-1] if rng.random() < 0.5 else sample.picture
    padded = np.pad(picture, ((SHIFT_PX, SHIFT_PX), (SHIFT_PX, SHIFT_PX), (0, 0)), mode="edge")
    top, left = rng.integers(0, 2 * SHIFT_PX + 1, 2)
    moved = padded[top : top + SIDE, left : left + SIDE]
    lit = np.clip(moved * rng.uniform(1 - GAIN, 1 + GAIN), 0, 255).astype(np.uint8)
    return Sample(lit, sample.label, sample.scene)


def batched(pictures: list[Picture]) -> NDArray[np.float32]:
    """Return (B, 3, 32, 32) pictures in [-1, 1]."""
    return np.stack(pictures).transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1
