"""The weather task: classification of the weather in camera images as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from flcav.dataset.store import Dataset
from flcav.perception.client import ANNOTATED, camera_ahead, picture_bytes
from flcav.perception.images import read_pictures
from flcav.perception.marks import Bars
from flcav.perception.study import StudyRecipe
from flcav.perception.task import Finding, Practice, Result
from flcav.perception.weather.config import CONFIGURATIONS, LeNetConfig
from flcav.perception.weather.evaluate import Classification, evaluate_classes
from flcav.perception.weather.model import Classifier, LeNet
from flcav.perception.weather.outcomes import WeatherOutcomes
from flcav.perception.weather.predict import predict_probabilities, tensor_of
from flcav.perception.weather.samples import Sample, augment, label_pictures, reduce_picture
from flcav.progress import Report, ignore_progress
from flcav.records import Class
from flcav.world.weather import WEATHER_CLASSES, find_nearest_class


@dataclass(frozen=True)
class Named(Result):
    """Classification of one image: the likeliest class, and the probability of each class."""

    label: Class
    probabilities: Mapping[str, float]  # by class

    def lines(self) -> list[str]:
        """Return one line with the class and its probability."""
        return [f"{self.label} ({self.probabilities[self.label]:.2f})"]


class WeatherTask(WeatherOutcomes):
    """Classification of the weather in a camera image."""

    name = "weather"
    family = "lenet"
    configurations = CONFIGURATIONS
    practice = Practice(batch=32, learning_rate=4e-3)
    recording: Mapping[str, Any] = {
        "vehicle_rig": camera_ahead(320, 192, 90.0),
        "weather": {"classes": list(WEATHER_CLASSES), "turn_s": 4.0},
    }
    labels = (ANNOTATED,)

    def study(self) -> StudyRecipe:
        """Return the study recipe, see `flcav.perception.weather.study`."""
        from flcav.perception.weather.study import STUDY

        return STUDY

    def build(self, config: LeNetConfig) -> Classifier:
        """Return a network with random initial weights."""
        return LeNet(config)

    def samples(self, data: Dataset, config: LeNetConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the images whose weather is in the region of one of the classes, see `labelled`."""
        return label_pictures(data, config.classes, frames)

    def draw(self, samples: Sequence[Sample], index: int, config: LeNetConfig, rng: np.random.Generator) -> Sample:
        """Return an augmented sample, see `flcav.perception.weather.samples.augment`."""
        return augment(samples[index], rng)

    def loss(self, network: Classifier, samples: Sequence[Sample]) -> Tensor:
        """Return the mean cross entropy of a batch."""
        logits = network(tensor_of(network, [sample.picture for sample in samples]))
        return functional.cross_entropy(logits, torch.tensor([s.label for s in samples], device=logits.device))

    def evaluate(
        self,
        network: Classifier,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> Classification:
        """Return accuracy, recall per class and the confusion matrix, see `classification`."""
        return evaluate_samples(network, self.samples(data, network.config, frames), progress)

    def sample_bytes(self, data: Dataset, config: LeNetConfig, frames: Sequence[int]) -> list[int]:
        """Return the size [B] of each frame's images, plus one byte for the class."""
        return [picture_bytes(data, i) + 1 for i in frames]

    def infer(
        self, network: Classifier, path: Path, threshold: float = 0.0, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the class probabilities and the likeliest class of each image at `path`; `threshold` has no effect."""
        classes = network.config.classes
        for origin, rgb in read_pictures(path, frames):
            shares = predict_probabilities(network, [reduce_picture(rgb)])[0]
            rows = {name: float(share) for name, share in zip(classes, shares, strict=True)}
            yield Finding(origin, rgb, Named(classes[int(shares.argmax())], rows), (Bars(rows),))


WEATHER = WeatherTask()


def evaluate_samples(
    network: Classifier, samples: Sequence[Sample], progress: Report = ignore_progress
) -> Classification:
    """Return the classification metrics of a network on labelled images, see `classification`."""
    found = predict_probabilities(network, [sample.picture for sample in samples], progress).argmax(1)
    truth = np.array([sample.label for sample in samples])
    return evaluate_classes(truth, found, [sample.scene for sample in samples], network.config.classes)


def evaluate_whole_space(network: Classifier, data: Dataset) -> Classification:
    """Return the classification metrics on all images: weathers outside the regions get the nearest class.

    Raises `InputError` as `labelled` does.
    """
    samples = label_pictures(data, network.config.classes, named=find_nearest_class)
    return evaluate_samples(network, samples)
