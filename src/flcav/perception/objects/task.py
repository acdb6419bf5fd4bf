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
from flcav.perception.metrics import interval_words
from flcav.perception.objects.area import rules, rules_lines
from flcav.perception.objects.augment import augment
from flcav.perception.objects.batch import batch_loss
from flcav.perception.objects.calibrate import OVERLAP, calibrate, trust
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.detect import detect
from flcav.perception.objects.errors import register_errors
from flcav.perception.objects.evaluate import detections_and_truths, score_detections
from flcav.perception.objects.infer import box_rows, point_clouds
from flcav.perception.objects.model import CONFIGURATIONS, Second, second
from flcav.perception.objects.outcomes import ObjectsOutcomes
from flcav.perception.objects.paste import Cutouts, cut, pasted
from flcav.perception.objects.samples import RecordedSweeps, Sample, fitting_frames
from flcav.perception.objects.slices import slice_lines, sliced
from flcav.perception.objects.truth import only_lidar
from flcav.perception.task import Finding, Practice, of_frames
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

    def build(self, config: SecondConfig) -> Second:
        """Return a fresh network."""
        return second(config)

    def samples(self, data: Dataset, config: SecondConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return each frame's sweep with its ground truth as labels, read when asked for."""
        return RecordedSweeps(data, config, of_frames(data, frames))

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
    ) -> dict[str, Any]:
        """Return AP per class, kind of overlap and IoU, with intervals over scenes; its slices; what to trust.

        `asked`: the network's configuration with a smaller range, see `flcav.perception.objects.area`.
        """
        numbers, classes = of_frames(data, frames), network.config.classes
        found, truths = detections_and_truths(
            network, map(data.frame, numbers), asked, total=len(numbers), progress=progress
        )
        summary = score_detections(found, truths, classes).summary() | {"rules": rules(asked or network.config)}
        return summary | {"slices": sliced(found, truths, classes), "trust": trust(found, truths, classes)}

    def calibrate(self, network: Second, data: Dataset, frames: Sequence[int] | None = None) -> None:
        """Set the calibration of the network's scores, see `flcav.perception.objects.calibrate`."""
        calibrate(network, map(data.frame, of_frames(data, frames)))

    def sample_bytes(self, data: Dataset, config: SecondConfig, frames: Sequence[int]) -> list[int]:
        """Return the bytes of each sweep with its annotation rows."""
        return [data.payload_bytes(i) for i in frames]

    def score(self, result: Mapping[str, Any]) -> float:
        """Return the mean over classes of AP in 3D at IoU 0.5; 0 where there was nothing to find."""
        known = [row["ap"] for row in result["scores"] if (row["kind"], row["iou"]) == ("3d", 0.5) and row["ap"]]
        return float(np.mean(known)) if known else 0.0

    def infer(
        self, network: Second, path: Path, threshold: float = THRESHOLD, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield {"boxes": [...]} for each point cloud of `path`, see `infer.point_clouds`."""
        for cloud in point_clouds(path, frames):
            found = detect(network, cloud.points, score_threshold=threshold)
            yield Finding(cloud.path, cloud.points, {"boxes": box_rows(found)}, (CloudBoxes(found),), cloud.view)

    def register_errors(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = THRESHOLD,
        progress: Report = silent,
    ) -> Registry:
        """Return the objects that are missed and invented, see `errors.register_errors`."""
        numbers = of_frames(data, frames)

        def found() -> Iterator[Boxes]:
            for done, number in enumerate(numbers, start=1):
                frame = data.frame(number)
                yield detect(network, frame.lidar[only_lidar(frame)], score_threshold=threshold)
                progress(done, len(numbers), "")

        return Registry(register_errors(map(data.frame, numbers), found(), network.config, threshold))

    def evaluation_lines(self, result: Mapping[str, Any]) -> list[str]:
        """Return one line per class, kind of overlap and IoU, and one per class and slice."""
        lines = [f"{result['frames']} frames of {result['scenes']} scenes", *rules_lines(result["rules"])]
        for row in result["scores"]:
            found = "nothing to find"
            if row["ap"] is not None:
                found = f"AP {row['ap']:.3f} {interval_words(row['low'], row['high'])}  AOS {row['aos']:.3f}"
            if row["right_headings"] is not None:
                found += f", {row['right_headings']:.0%} of those found head the right way"
            counts = f"objects: {row['targets']}, and {row['hidden']} without a return"
            lines.append(f"{row['class']:<12}{row['kind']:>4} IoU {row['iou']:.1f}  {found}  ({counts})")
        lines += [f"at IoU {OVERLAP:g} by distance, occlusion and weather:", *slice_lines(result["slices"], OVERLAP)]
        for row in result["trust"]:
            if row["ece"] is not None:
                lines.append(f"{row['class']:<12}expected calibration error {row['ece']:.3f}")
        return lines

    def finding_lines(self, result: Mapping[str, Any]) -> list[str]:
        """Return one line per box."""
        lines = [f"{len(result['boxes'])} objects"]
        for box in result["boxes"]:
            place = f"at ({box['x']:.1f}, {box['y']:.1f}, {box['z']:.1f}) m, yaw {box['yaw']:.2f} rad"
            size = f"{box['length']:.1f} x {box['width']:.1f} x {box['height']:.1f} m"
            lines.append(f"{box['class']:<11}{box['score']:.2f}  {place}, {size}")
        return lines


OBJECTS = ObjectsTask()
