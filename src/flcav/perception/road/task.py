"""The road task: semantic road perception in camera images, as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.client import ANNOTATED, camera_ahead
from flcav.perception.road.evaluate import SCORE, RoadEvaluation, RoadOutcomes, summarise
from flcav.perception.road.loss import segmentation_loss
from flcav.perception.road.model import CONFIGURATIONS, RoadConfig, RoadNetwork
from flcav.perception.road.predict import find_roads
from flcav.perception.road.samples import RecordedRoads, Sample, draw_window, list_pictures, pack_roads, unpack_roads
from flcav.perception.study import StudyRecipe, read_recipe
from flcav.perception.task import Finding, Practice
from flcav.world.weather import WEATHER_CLASSES

BY_DAY = ("clear", "cloudy", "overcast")
UNSEEN = "unseen town by day"  # test in a town without training data


class RoadTask(RoadOutcomes):
    """Classes of road markings by pixel, and lane lines as polylines in picture and ground plane."""

    name = "road"
    family = "road-fpn"
    configurations = CONFIGURATIONS
    practice = Practice(batch=4, learning_rate=2e-3)
    recording: Mapping[str, Json] = {
        "vehicle_rig": camera_ahead(640, 384, 60.0),
        "weather": {"classes": list(WEATHER_CLASSES)},
    }
    labels = (ANNOTATED,)

    def study(self) -> StudyRecipe:
        """Return the study recipe: training in three towns, tests on held-out scenes and in a town without any.

        The held-out scenes are in all weathers, the unseen town is by day and dry.
        """
        recipe = read_recipe("road")
        return StudyRecipe(
            network="small",
            train=(
                recipe,
                {**recipe, "town": "grid", "seed": 117, "scenes": 16},
                {**recipe, "town": "suburb", "seed": 217, "scenes": 16},
            ),
            validation={**recipe, "seed": 317, "split": "validation", "scenes": 6},
            tests={
                "held-out scenes": {**recipe, "seed": 457, "split": "test", "scenes": 10},
                UNSEEN: {
                    **recipe,
                    "town": "ring",
                    "seed": 557,
                    "split": "test",
                    "scenes": 10,
                    "weather": {"classes": list(BY_DAY), "turn_s": 6.0},
                },
            },
            epochs=12,
            patience=12,
        )

    def build(self, config: RoadConfig) -> RoadNetwork:
        """Return a network with random initial weights."""
        return RoadNetwork(config)

    def samples(self, data: Dataset, config: RoadConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the labelled images of all cameras, read on access; raises `InputError` as `RecordedRoads` does."""
        return RecordedRoads(data, frames)

    def draw(self, samples: Sequence[Sample], index: int, config: RoadConfig, rng: np.random.Generator) -> Sample:
        """Return an augmented window of a sample, see `flcav.perception.road.samples.draw_window`."""
        return draw_window(samples[index], config, rng)

    def loss(self, network: RoadNetwork, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of a batch of images of one size, see `segmentation_loss`."""
        return segmentation_loss(network, samples)

    def evaluate(
        self,
        network: RoadNetwork,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> RoadEvaluation:
        """Return the F1 of lane lines, IoU by class, errors on the ground, and measures by weather and light."""
        return summarise(self.outcomes(network, data, data.numbers(frames), progress))

    def pack_samples(self, data: Dataset, config: RoadConfig, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the message of each frame: its images and their classes."""
        list_pictures(data, frames)  # raises for frames that cannot be used
        return (pack_roads(data, i) for i in frames)

    def unpack_samples(self, messages: Sequence[bytes], config: RoadConfig) -> list[Sample]:
        """Return the samples in messages of `pack_samples`."""
        return [sample for message in messages for sample in unpack_roads(message)]

    def infer(
        self, network: RoadNetwork, path: Path, threshold: float = SCORE, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the classes and lane lines in each image at `path`, see `flcav.perception.road.predict`."""
        yield from find_roads(network, path, threshold, frames)


ROAD = RoadTask()
