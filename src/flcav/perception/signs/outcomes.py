"""Outcomes of the sign task: detections and ground truth of each image, and COCO's mAP of bootstrap samples."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.outcomes import Outcomes, Times, Values
from flcav.perception.signs.config import SignsConfig
from flcav.perception.signs.evaluate import SignTruth, mean_average_precision
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.predict import SignDetections, detect
from flcav.perception.signs.samples import RecordedPictures

LOWEST_SCORE = 0.01  # score threshold; detections below it hardly change the average precision
FOUND, WANTED, NEUTRAL = "found", "wanted", "neutral"
CLASSES, SMALLEST = "classes", "smallest_px"


class SignsOutcomes:
    """Measure of the sign task: COCO's mAP at IoU 0.5."""

    measure_name = "mAP50"
    redraws = 200  # few, since each bootstrap sample matches all images again

    def outcomes(
        self, network: SignDetector, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return detections and ground truth of each image, flattened, with the counts per image."""
        recorded = _last_asked_for(data, network.config, tuple(frames))
        found, truths = [], []
        for done, sample in enumerate(recorded, start=1):
            truths.append(SignTruth(sample.boxes, sample.label, sample.ignore))
            found.append(detect(network, sample.picture, threshold=LOWEST_SCORE))
            progress(done, len(recorded), "")
        arrays = {
            f"{FOUND}/box": _joined([one.box for one in found], 4),
            f"{FOUND}/label": np.concatenate([np.zeros(0, np.int64), *(one.label for one in found)]),
            f"{FOUND}/score": np.concatenate([np.zeros(0), *(one.score for one in found)]),
            f"{FOUND}/count": np.array([len(one) for one in found]),
            f"{WANTED}/box": _joined([truth.box for truth in truths], 4),
            f"{WANTED}/label": np.concatenate([np.zeros(0, np.int64), *(truth.label for truth in truths)]),
            f"{WANTED}/count": np.array([len(truth.box) for truth in truths]),
            f"{NEUTRAL}/box": _joined([truth.neutral for truth in truths], 4),
            f"{NEUTRAL}/count": np.array([len(truth.neutral) for truth in truths]),
            CLASSES: np.array(network.config.classes),
            SMALLEST: np.array(network.config.smallest_px),
        }
        return Outcomes(np.array([recorded.scene(number) for number in range(len(recorded))]), arrays)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return mAP at IoU 0.5 of each bootstrap sample; NaN without targets."""
        found, truths = by_picture(outcomes)
        classes, smallest = outcomes.arrays[CLASSES].tolist(), float(outcomes.arrays[SMALLEST])
        values = []
        for counts in times:
            drawn = np.repeat(np.arange(len(counts)), counts)
            result = mean_average_precision([found[i] for i in drawn], [truths[i] for i in drawn], classes, smallest)
            values.append(np.nan if result.map50 is None else result.map50)
        return np.array(values, dtype=np.float64)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return mAP averaged over IoU 0.5 to 0.95, and the number of targets."""
        found, truths = by_picture(outcomes)
        classes, smallest = outcomes.arrays[CLASSES].tolist(), float(outcomes.arrays[SMALLEST])
        result = mean_average_precision(found, truths, classes, smallest)
        return {"mAP50-95": result.map50_95, "targets": float(len(outcomes.arrays[f"{WANTED}/label"]))}


def by_picture(outcomes: Outcomes) -> tuple[list[SignDetections], list[SignTruth]]:
    """Return the detections and the ground truth of each image."""

    def parts(name: str, field: str) -> list[np.ndarray]:
        ends = np.cumsum(outcomes.arrays[f"{name}/count"])[:-1]
        return np.split(outcomes.arrays[f"{name}/{field}"], ends)

    found = [SignDetections(*one) for one in zip(*(parts(FOUND, field) for field in ("box", "label", "score")))]
    truths = [SignTruth(*one) for one in zip(parts(WANTED, "box"), parts(WANTED, "label"), parts(NEUTRAL, "box"))]
    return found, truths


def _joined(boxes: Sequence[np.ndarray], width: int) -> np.ndarray:
    return np.concatenate([np.zeros((0, width)), *boxes])


@lru_cache(maxsize=1)
def _last_asked_for(data: Dataset, config: SignsConfig, frames: tuple[int, ...]) -> RecordedPictures:
    """Return the images with their labels, cached: each validation of a training asks for the same ones."""
    return RecordedPictures(data, config, frames)
