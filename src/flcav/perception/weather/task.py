"""The weather task: classification of the weather in camera images as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from flcav.arrays import Array32
from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.client import ANNOTATED, camera_ahead
from flcav.perception.study import StudyRecipe, read_recipe
from flcav.perception.task import Finding, Practice
from flcav.perception.weather.evaluate import (
    Classification,
    WeatherOutcomes,
    classify_pictures,
    evaluate_samples,
    predict_probabilities,
    tensor_of,
)
from flcav.perception.weather.model import CONFIGURATIONS, Classifier, LeNet, LeNetConfig
from flcav.perception.weather.samples import (
    Sample,
    augment_picture,
    label_pictures,
    pack_pictures_and_weather,
    unpack_frame,
)
from flcav.world.weather import ANY, WEATHER_CLASSES

WHOLE_SPACE = "whole space"  # test of weathers drawn from the whole space of parameters


class WeatherTask(WeatherOutcomes):
    """Classification of the weather in a camera image."""

    name = "weather"
    family = "lenet"
    configurations = CONFIGURATIONS
    practice = Practice(batch=32, learning_rate=4e-3)
    recording: Mapping[str, Json] = {
        "vehicle_rig": camera_ahead(320, 192, 90.0),
        "weather": {"classes": list(WEATHER_CLASSES), "turn_s": 4.0},
    }
    labels = (ANNOTATED,)

    def study(self) -> StudyRecipe:
        """Return the study recipe: training in three towns, tests on held-out scenes, a held-out town, any weather.

        Each scene goes once through all eight classes, so that they are balanced. The test `WHOLE_SPACE` also draws
        weathers between the classes' regions.
        """
        recipe = read_recipe("weather")
        any_weather = {"classes": [ANY] * 8, "turn_s": 4.0}
        return StudyRecipe(
            network="tiny",
            train=(recipe, {**recipe, "town": "suburb", "seed": 113}, {**recipe, "town": "arterial", "seed": 613}),
            validation={**recipe, "seed": 213, "split": "validation", "scenes": 20},
            tests={
                "held-out scenes": {**recipe, "seed": 1013, "split": "test", "scenes": 12},
                "held-out town": {**recipe, "town": "grid", "seed": 1113, "split": "test", "scenes": 12},
                WHOLE_SPACE: {**recipe, "seed": 1213, "split": "test", "scenes": 12, "weather": any_weather},
            },
            epochs=60,
            patience=15,
        )

    def build(self, config: LeNetConfig) -> Classifier:
        """Return a network with random initial weights."""
        return LeNet(config)

    def samples(self, data: Dataset, config: LeNetConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the images whose weather is in the region of one of the classes, see `label_pictures`."""
        return label_pictures(data, config.classes, frames)

    def draw(self, samples: Sequence[Sample], index: int, config: LeNetConfig, rng: np.random.Generator) -> Sample:
        """Return an augmented sample, see `flcav.perception.weather.samples`."""
        return augment_picture(samples[index], rng)

    def loss(self, network: Classifier, samples: Sequence[Sample]) -> Tensor:
        """Return the mean cross entropy of a batch."""
        logits = network(tensor_of(network, [sample.picture for sample in samples]))
        return functional.cross_entropy(logits, torch.tensor([s.label for s in samples], device=logits.device))

    def class_probabilities(self, network: Classifier, samples: Sequence[Sample]) -> list[Array32]:
        """Return the class probabilities (1, classes) of each image."""
        return [*predict_probabilities(network, [sample.picture for sample in samples])[:, None]]

    def imitation_loss(self, network: Classifier, samples: Sequence[Sample], targets: Sequence[Array32]) -> Tensor:
        """Return the mean cross entropy of a batch with class probabilities for targets."""
        logits = network(tensor_of(network, [sample.picture for sample in samples]))
        return functional.cross_entropy(logits, torch.from_numpy(np.concatenate(targets)).to(logits))

    def evaluate(
        self,
        network: Classifier,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> Classification:
        """Return accuracy, recall per class and the confusion matrix, see `evaluate_classes`."""
        return evaluate_samples(network, self.samples(data, network.config, frames), progress)

    def pack_samples(self, data: Dataset, config: LeNetConfig, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the message of each frame: its images and their class."""
        label_pictures(data, config.classes, frames)  # raises for frames that cannot be used
        return (pack_pictures_and_weather(data, i) for i in frames)

    def unpack_samples(self, messages: Sequence[bytes], config: LeNetConfig) -> list[Sample]:
        """Return the samples in messages of `pack_samples`."""
        return [sample for message in messages for sample in unpack_frame(message, config.classes)]

    def infer(
        self, network: Classifier, path: Path, threshold: float = 0.0, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the class probabilities and the likeliest class of each image at `path`; `threshold` has no effect."""
        yield from classify_pictures(network, path, frames)


WEATHER = WeatherTask()
