"""Detection of signs and traffic lights as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from flcav.dataset.store import Dataset
from flcav.perception.errors import THRESHOLD, Registry
from flcav.perception.images import pictures
from flcav.perception.marks import PictureBoxes
from flcav.perception.sharing import ANNOTATED, camera_ahead, picture_bytes
from flcav.perception.signs.augment import draw
from flcav.perception.signs.config import CONFIGURATIONS, SignsConfig
from flcav.perception.signs.detect import Detections, detect, predict
from flcav.perception.signs.errors import register_errors
from flcav.perception.signs.evaluate import mean_average_precision
from flcav.perception.signs.loss import detection_loss
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.outcomes import SignsOutcomes, by_picture
from flcav.perception.signs.samples import RecordedPictures, Sample
from flcav.perception.signs.targets import assign
from flcav.perception.task import Finding, Practice, of_frames
from flcav.progress import Report, silent

BOX_BYTES = 4 * 4 + 1  # of a label: a box in float32, and its class


class SignsTask(SignsOutcomes):
    """Boxes of signs and signal heads in a camera picture, and what they show."""

    name = "signs"
    family = "yolo"
    configurations = CONFIGURATIONS
    practice = Practice(batch=8, learning_rate=2e-3)
    recording: Mapping[str, Any] = {
        "vehicle_rig": camera_ahead(640, 384, 45.0),
        "weather": {"classes": ["clear", "cloudy", "overcast", "light_rain"]},
    }
    labels = (ANNOTATED,)
    threshold = THRESHOLD

    def build(self, config: SignsConfig) -> SignDetector:
        """Return a fresh network."""
        return SignDetector(config)

    def samples(self, data: Dataset, config: SignsConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return every camera's pictures with their signs and lights, read when asked for."""
        return RecordedPictures(data, config, frames)

    def draw(self, samples: Sequence[Sample], index: int, config: SignsConfig, rng: np.random.Generator) -> Sample:
        """Return a window of the sample, or a mosaic with others, in changed colours."""
        return draw(samples, index, config, rng)

    def loss(self, network: SignDetector, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of a batch of pictures of one size, both sides multiples of 32."""
        raw = predict(network, [sample.picture for sample in samples])
        return detection_loss(raw, assign(samples, network.config), network.config)

    def evaluate(
        self, network: SignDetector, data: Dataset, frames: Sequence[int] | None = None, *, progress: Report = silent
    ) -> dict[str, Any]:
        """Return COCO's mAP, by class and by size, see `mean_average_precision`."""
        kept = self.outcomes(network, data, of_frames(data, frames), progress)
        found, truths = by_picture(kept)
        result = mean_average_precision(found, truths, network.config.classes, network.config.smallest_px)
        return result | {"scenes": len(set(kept.scene.tolist()))}

    def sample_bytes(self, data: Dataset, config: SignsConfig, frames: Sequence[int]) -> list[int]:
        """Return the bytes of each frame's pictures with their boxes: four float32 and a class."""
        return [
            picture_bytes(data, i) + BOX_BYTES * sum(map(len, data.frame(i).annotations.signs.values())) for i in frames
        ]

    def score(self, result: Mapping[str, Any]) -> float:
        """Return mAP at IoU 0.5; 0 where there was nothing to find."""
        return result["map50"] or 0.0

    def infer(
        self, network: SignDetector, path: Path, threshold: float = THRESHOLD, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield {"boxes": [...]} for each picture of `path`, best first."""
        for origin, rgb in pictures(path, frames):
            found = detect(network, rgb, threshold=threshold)
            names = np.array(network.config.classes)[found.label]
            marks = (PictureBoxes(found.box, names, found.score),)
            yield Finding(origin, rgb, {"boxes": box_rows(found, network.config.classes)}, marks)

    def register_errors(
        self,
        network: SignDetector,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = THRESHOLD,
        progress: Report = silent,
    ) -> Registry:
        """Return the signs that are missed and invented, see `errors.register_errors`."""
        return register_errors(network, data, of_frames(data, frames), threshold, progress)

    def evaluation_lines(self, result: Mapping[str, Any]) -> list[str]:
        """Return mAP, then AP by class and by size."""
        seen = f"{result['pictures']} pictures of {result['scenes']} scenes"
        lines = [f"{seen}: mAP50 {_known(result['map50'])}, mAP50-95 {_known(result['map50_95'])}"]
        for row in result["classes"]:
            lines.append(f"{row['class']:<14}AP50 {_known(row['ap50'])}  ({row['targets']} to find)")
        for row in result["sizes"]:
            span = f"{row['from_px']:g} px on" if row["to_px"] is None else f"{row['from_px']:g}-{row['to_px']:g} px"
            lines.append(f"{span:<14}mAP50 {_known(row['map50'])}  ({row['targets']} to find)")
        return [*lines, f"{result['neutral']} more were too small or cut off: neither asked for nor counted as false"]

    def finding_lines(self, result: Mapping[str, Any]) -> list[str]:
        """Return one line per box."""
        lines = [f"{len(result['boxes'])} signs and lights"]
        for box in result["boxes"]:
            corners = f"({box['x1']:.1f}, {box['y1']:.1f}) to ({box['x2']:.1f}, {box['y2']:.1f}) px"
            lines.append(f"{box['class']:<14}{box['score']:.2f}  {corners}")
        return lines


SIGNS = SignsTask()


def box_rows(found: Detections, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Return one dictionary per box: class, score, corners [px] from the upper left corner of the picture."""
    return [
        {"class": classes[label], "score": float(score)}
        | {name: float(value) for name, value in zip(("x1", "y1", "x2", "y2"), box, strict=True)}
        for box, label, score in zip(found.box, found.label, found.score, strict=True)
    ]


def _known(value: float | None) -> str:
    return "unknown (nothing to find)" if value is None else f"{value:.3f}"
