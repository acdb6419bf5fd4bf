"""The sign task: detection of traffic signs and traffic lights, as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from flcav.arrays import Array32
from flcav.config import InputError, Json
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.client import ANNOTATED, camera_ahead
from flcav.perception.errors import THRESHOLD, Registry
from flcav.perception.signs.errors import register_sign_errors
from flcav.perception.signs.evaluate import SignsEvaluation, SignsOutcomes, by_picture, mean_average_precision
from flcav.perception.signs.loss import assign_levels, class_probabilities, detection_loss, number_boxes
from flcav.perception.signs.model import CONFIGURATIONS, SignDetector, SignsConfig
from flcav.perception.signs.predict import detect_signs, predict_levels
from flcav.perception.signs.samples import RecordedPictures, Sample, draw_mosaic, pack_signs, unpack_signs
from flcav.perception.study import StudyRecipe, read_recipe
from flcav.perception.task import Finding, Practice


class SignsTask(SignsOutcomes):
    """2D detection of signs and signal heads in camera images, classified by their meaning."""

    name = "signs"
    family = "yolo"
    configurations = CONFIGURATIONS
    practice = Practice(batch=8, learning_rate=2e-3)
    recording: Mapping[str, Json] = {
        "vehicle_rig": camera_ahead(640, 384, 45.0),
        "weather": {"classes": ["clear", "cloudy", "overcast", "light_rain"]},
    }
    labels = (ANNOTATED,)
    threshold = THRESHOLD

    def study(self) -> StudyRecipe:
        """Return the study recipe: training in three towns, tests on held-out scenes and on a held-out town.

        The held-out scenes have all eight classes; the held-out town has only speed limits of 30, yield signs and
        lights.
        """
        arterial = read_recipe("signs")
        ring = {**arterial, "town": "ring", "warmup_s": [87.0, 89.5]}
        return StudyRecipe(
            network="n",
            train=(arterial, read_recipe("signs_suburb"), read_recipe("signs_grid")),
            validation={**arterial, "seed": 114, "split": "validation", "scenes": 6},
            tests={
                "held-out scenes": {**arterial, "seed": 414, "split": "test", "scenes": 12},
                "held-out town": {**ring, "seed": 514, "split": "test", "scenes": 10},
            },
            epochs=15,
            patience=15,
        )

    def build(self, config: SignsConfig) -> SignDetector:
        """Return a network with random initial weights."""
        return SignDetector(config)

    def samples(self, data: Dataset, config: SignsConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the labelled images of all cameras, read on access; raises `InputError` if no frame has a camera."""
        return RecordedPictures(data, config, frames)

    def draw(self, samples: Sequence[Sample], index: int, config: SignsConfig, rng: np.random.Generator) -> Sample:
        """Return an augmented sample, see `flcav.perception.signs.samples.draw_mosaic`."""
        return draw_mosaic(samples, index, config, rng)

    def loss(self, network: SignDetector, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of a batch of images of one size, whose sides are multiples of 32."""
        raw = predict_levels(network, [sample.picture for sample in samples])
        return detection_loss(raw, assign_levels(samples, network.config), network.config)

    def class_probabilities(self, network: SignDetector, samples: Sequence[Sample]) -> list[Array32]:
        """Return the class probabilities (boxes, classes) of the boxes of each image."""
        return class_probabilities(network, samples)

    def imitation_loss(self, network: SignDetector, samples: Sequence[Sample], targets: Sequence[Array32]) -> Tensor:
        """Return the loss of a batch whose boxes have class probabilities instead of labels."""
        raw, shares = (
            predict_levels(network, [sample.picture for sample in samples]),
            torch.from_numpy(np.concatenate(targets)),
        )
        return detection_loss(raw, assign_levels(number_boxes(samples), network.config), network.config, shares)

    def evaluate(
        self,
        network: SignDetector,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> SignsEvaluation:
        """Return COCO's mAP, in total, by class and by size; see `mean_average_precision`."""
        kept = self.outcomes(network, data, data.numbers(frames), progress)
        found, truths = by_picture(kept)
        result = mean_average_precision(found, truths, network.config.classes, network.config.smallest_px)
        return replace(result, scenes=len(set(kept.scene.tolist())))

    def check_for_vehicles(self, config: SignsConfig) -> None:
        """Raise `InputError` for a network that needs the static background, since vehicles have none."""
        if config.background:
            raise InputError("signs: this network sees pictures of poles beside their background, vehicles have none")

    def pack_samples(self, data: Dataset, config: SignsConfig, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the messages of frames, with their images and boxes."""
        self.check_for_vehicles(config)
        RecordedPictures(data, config, frames)  # raises for frames without cameras
        return (pack_signs(data, i, config) for i in frames)

    def unpack_samples(self, messages: Sequence[bytes], config: SignsConfig) -> list[Sample]:
        """Return the samples in messages of `pack_samples`."""
        return [sample for message in messages for sample in unpack_signs(message)]

    def infer(
        self, network: SignDetector, path: Path, threshold: float = THRESHOLD, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the detections in each image at `path`, by falling score, see `flcav.perception.signs.predict`."""
        yield from detect_signs(network, path, threshold, frames)

    def register_errors(
        self,
        network: SignDetector,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = THRESHOLD,
        progress: Report = ignore_progress,
    ) -> Registry:
        """Return the missed signs and the false positives, see `flcav.perception.signs.errors.register_sign_errors`."""
        if network.config.labels != "signs":
            raise InputError(f"errors of signs: this network finds {', '.join(network.config.classes)}, which are none")
        data.check_labelled("signs")
        return register_sign_errors(network, data, data.numbers(frames), threshold, progress)


SIGNS = SignsTask()
