"""Object detection as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.perception.errors import THRESHOLD, Registry
from flcav.perception.marks import CloudBoxes
from flcav.perception.objects.area import rules
from flcav.perception.objects.augment import Cutouts, augment, cut, pasted
from flcav.perception.objects.calibrate import calibrate, trust
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.detect import detect
from flcav.perception.objects.errors import register_errors
from flcav.perception.objects.evaluate import detections_and_truths, score_detections
from flcav.perception.objects.infer import ObjectsFound, box_rows, point_clouds
from flcav.perception.objects.loss import batch_loss
from flcav.perception.objects.model import CONFIGURATIONS, Second, second
from flcav.perception.objects.outcomes import ObjectsOutcomes
from flcav.perception.objects.results import ObjectsEvaluation, sliced
from flcav.perception.objects.samples import RecordedSweeps, Sample, fitting_frames
from flcav.perception.objects.truth import only_lidar
from flcav.perception.study import StudyRecipe
from flcav.perception.task import Finding, Practice
from flcav.progress import Report, silent


class ObjectsTask(ObjectsOutcomes):
    """3D boxes of road users in a LiDAR sweep."""

    name = "objects"
    family = "second"
    configurations = CONFIGURATIONS
    practice = Practice(batch=2, learning_rate=2e-3)
    recording: Mapping[str, Any] = {}
    labels = ("ideal-road", "own-detections")
    threshold = THRESHOLD

    def __init__(self) -> None:
        self._cut: tuple[Sequence[Sample], Cutouts] | None = None  # what was cut out last, and of which samples

    def study(self) -> StudyRecipe:
        """Return how it is studied, see `flcav.perception.objects.study`."""
        from flcav.perception.objects.study import STUDY

        return STUDY

    def build(self, config: SecondConfig) -> Second:
        """Return a fresh network."""
        return second(config)

    def samples(self, data: Dataset, config: SecondConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return each frame's sweep with its ground truth as labels, read when asked for."""
        return RecordedSweeps(data, config, data.numbers(frames))

    def fitting(self, data: Dataset, config: SecondConfig) -> Sequence[int]:
        """Return the frames whose LiDAR is about as high as the network expects, see `fitting_frames`."""
        return fitting_frames(data, config)

    def draw(self, samples: Sequence[Sample], index: int, config: SecondConfig, rng: np.random.Generator) -> Sample:
        """Return the sample with objects of all pasted into it, then changed as `config.augmentation` says.

        What can be pasted is cut out of all samples when one of them is drawn first.
        """
        how = config.augmentation
        sample = samples[index]
        if how.paste:
            sample = pasted(sample, self._cutouts(samples, config), how.paste, rng)
        return augment(sample, how, rng)

    def _cutouts(self, samples: Sequence[Sample], config: SecondConfig) -> Cutouts:
        if self._cut is None or self._cut[0] is not samples:
            self._cut = samples, cut((samples[number] for number in range(len(samples))), config)
        return self._cut[1]

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return SECOND's loss of a batch."""
        return batch_loss(network, samples)

    def evaluate(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        asked: SecondConfig | None = None,
        progress: Report = silent,
    ) -> ObjectsEvaluation:
        """Return AP per class, kind of overlap and IoU, with intervals over scenes; its slices; what to trust.

        `asked`: the network's configuration with a smaller range, see `flcav.perception.objects.area`.
        """
        numbers, classes = data.numbers(frames), network.config.classes
        found, truths = detections_and_truths(
            network, map(data.frame, numbers), asked, total=len(numbers), progress=progress
        )
        return ObjectsEvaluation(
            frames=len(truths),
            scenes=len({truth.scene for truth in truths}),
            scores=score_detections(found, truths, classes),
            rules=rules(asked or network.config),
            slices=sliced(found, truths, classes),
            trust=trust(found, truths, classes),
        )

    def calibrate(self, network: Second, data: Dataset, frames: Sequence[int] | None = None) -> None:
        """Set the calibration of the network's scores, see `flcav.perception.objects.calibrate`."""
        calibrate(network, map(data.frame, data.numbers(frames)))

    def sample_bytes(self, data: Dataset, config: SecondConfig, frames: Sequence[int]) -> list[int]:
        """Return the bytes of each sweep with its annotation rows."""
        return [data.payload_bytes(i) for i in frames]

    def infer(
        self, network: Second, path: Path, threshold: float = THRESHOLD, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the objects in each point cloud of `path`, see `infer.point_clouds`."""
        for cloud in point_clouds(path, frames):
            found = detect(network, cloud.points, score_threshold=threshold)
            yield Finding(cloud.path, cloud.points, ObjectsFound(box_rows(found)), (CloudBoxes(found),), cloud.view)

    def register_errors(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = THRESHOLD,
        progress: Report = silent,
    ) -> Registry:
        """Return the objects that are missed and invented, see `errors.register_errors`."""
        numbers = data.numbers(frames)

        def found() -> Iterator[Boxes]:
            for done, number in enumerate(numbers, start=1):
                frame = data.frame(number)
                yield detect(network, frame.lidar[only_lidar(frame)], score_threshold=threshold)
                progress(done, len(numbers), "")

        return Registry(register_errors(map(data.frame, numbers), found(), network.config, threshold))


OBJECTS = ObjectsTask()
