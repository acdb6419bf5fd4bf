"""Augmentation of images of the weather: mirroring, shift, gain, gamma and saturation."""

import numpy as np

from flcav.perception.weather.model import SIDE
from flcav.perception.weather.samples import Sample

SHIFT_PX = 3  # largest shift of augmentation
GAIN, GAMMA, SATURATION = 0.05, 0.2, 0.25  # largest absolute logarithms of augmentation's random factors


def augment(sample: Sample, rng: np.random.Generator) -> Sample:
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
