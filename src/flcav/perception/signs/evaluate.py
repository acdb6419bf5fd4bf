"""COCO's mean average precision of the sign detector, by class and size; outcomes per image for the bootstrap."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from faster_coco_eval import COCO, COCOeval_faster

from flcav.arrays import Array, Ints
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.outcomes import Outcomes, Times, Values
from flcav.perception.signs.model import SignDetector, SignsConfig
from flcav.perception.signs.predict import SignDetections, detect_in_picture
from flcav.perception.signs.samples import RecordedPictures, size_px
from flcav.perception.task import Evaluated
from flcav.storage.records import Class

EDGES_PX = (12.0, 24.0)  # borders between small, medium and large, as roots of a box's area
LARGEST_PX = 1e5
ALL, FIFTY = 0, 0  # index of the area range of all sizes; index of the IoU threshold 0.5


@dataclass(frozen=True)
class SignTruth:
    """Ground truth of an image."""

    box: Array  # (N, 4) x1 y1 x2 y2 [px] of the targets
    label: Ints  # (N,) index of the class
    neutral: Array  # (K, 4) boxes whose detection, as any class, is neither right nor wrong


@dataclass(frozen=True)
class ClassPrecision:
    """Average precision of a class; None without targets."""

    label: Class
    ap50: float | None
    ap50_95: float | None
    targets: int

    @property
    def name(self) -> str:
        """Return the class in words."""
        return self.label.replace("_", " ")


@dataclass(frozen=True)
class SizePrecision:
    """Mean average precision for one size of targets, the square root of a box's area; None without targets."""

    from_px: float
    to_px: float | None  # None: no upper limit
    map50: float | None
    targets: int

    @property
    def name(self) -> str:
        """Return the range of sizes in words."""
        return f"{self.from_px:g} px on" if self.to_px is None else f"{self.from_px:g} to {self.to_px:g} px"


@dataclass(frozen=True)
class SignsEvaluation(Evaluated):
    """COCO's mean average precision, in total, by class and by size; None without targets."""

    map50: float | None  # at IoU 0.5
    map50_95: float | None  # averaged over IoU 0.5 to 0.95
    classes: tuple[ClassPrecision, ...]
    sizes: tuple[SizePrecision, ...]
    neutral: int  # number of neutral boxes, whose detection is neither right nor wrong
    pictures: int  # number of images
    scenes: int = 1  # number of scenes of the images

    @property
    def score(self) -> float:
        """Return mAP at IoU 0.5; 0 without targets."""
        return self.map50 or 0.0

    def numbers(self) -> Mapping[str, float]:
        """Return mAP, and AP50 by class and by size, as far as there are targets."""
        means = {"mAP50": self.map50, "mAP50-95": self.map50_95}
        classes = {row.name: row.ap50 for row in self.classes}
        sizes = {row.name: row.map50 for row in self.sizes}
        return {name: value for name, value in (means | classes | sizes).items() if value is not None}

    def lines(self) -> list[str]:
        """Return mAP, then AP by class and by size."""
        seen = f"{plural(self.pictures, 'picture')} of {plural(self.scenes, 'scene')}"
        lines = [f"{seen}: mAP50 {_known(self.map50)}, mAP50-95 {_known(self.map50_95)}"]
        for row in self.classes:
            lines.append(f"{row.label:<14}AP50 {_known(row.ap50)}  ({row.targets} to find)")
        for row in self.sizes:
            span = f"{row.from_px:g} px on" if row.to_px is None else f"{row.from_px:g}-{row.to_px:g} px"
            lines.append(f"{span:<14}mAP50 {_known(row.map50)}  ({row.targets} to find)")
        return [*lines, f"{self.neutral} more were too small or cut off: neither asked for nor counted as false"]


def mean_average_precision(
    found: Sequence[SignDetections], truths: Sequence[SignTruth], classes: Sequence[str], smallest_px: float
) -> SignsEvaluation:
    """Return mAP at IoU 0.5 and averaged over IoU 0.5 to 0.95, by class and by size of the true box.

    `found` and `truths` have one entry per image. Detections that are smaller than `smallest_px` [px], or match only a
    neutral box (COCO's "crowd": the intersection is divided by the detection's area), are neither right nor wrong.
    """
    edges = (smallest_px, *EDGES_PX, LARGEST_PX)
    ranges = [(smallest_px, LARGEST_PX), *pairwise(edges)]
    evaluated = _evaluated(found, truths, classes, ranges)
    precision = evaluated.eval["precision"][..., -1]  # (IoU, recall, class, range); -1 where nothing is to be found
    sizes = np.concatenate([np.zeros(0), *(size_px(truth.box) for truth in truths)])
    label = np.concatenate([np.zeros(0, np.int64), *(truth.label for truth in truths)])
    return SignsEvaluation(
        map50=_mean(precision[FIFTY, :, :, ALL]),
        map50_95=_mean(precision[:, :, :, ALL]),
        classes=tuple(
            ClassPrecision(
                name,
                ap50=_mean(precision[FIFTY, :, number, ALL]),
                ap50_95=_mean(precision[:, :, number, ALL]),
                targets=int((label == number).sum()),
            )
            for number, name in enumerate(classes)
        ),
        sizes=tuple(
            SizePrecision(
                low,
                None if high == LARGEST_PX else high,
                map50=_mean(precision[FIFTY, :, :, 1 + number]),
                targets=int(((sizes >= low) & (sizes < high)).sum()),
            )
            for number, (low, high) in enumerate(pairwise(edges))
        ),
        neutral=sum(len(truth.neutral) for truth in truths),
        pictures=len(truths),
    )


def _evaluated(
    found: Sequence[SignDetections],
    truths: Sequence[SignTruth],
    classes: Sequence[str],
    ranges: Sequence[tuple[float, float]],
) -> COCOeval_faster:
    annotations = [
        {"image_id": image, "category_id": number, "bbox": _corner_and_size(box), "iscrowd": int(crowd)}
        for image, truth in enumerate(truths)
        for number in range(len(classes))
        for crowd, boxes in ((False, truth.box[truth.label == number]), (True, truth.neutral))
        for box in boxes
    ]
    detections = [
        {"image_id": image, "category_id": int(label), "bbox": _corner_and_size(box), "score": float(score)}
        for image, one in enumerate(found)
        for box, label, score in zip(one.box, one.label, one.score, strict=True)
    ]
    for number, row in enumerate(annotations):
        row |= {"id": number + 1, "area": row["bbox"][2] * row["bbox"][3]}
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(
            {
                "images": [{"id": image} for image in range(len(truths))],
                "annotations": annotations,
                "categories": [{"id": number, "name": name} for number, name in enumerate(classes)],
            }
        )
        evaluation = COCOeval_faster(truth, truth.loadRes(detections), "bbox", print_function=lambda *_: None)
        evaluation.params.areaRng = [[low**2, high**2] for low, high in ranges]
        evaluation.params.areaRngLbl = [f"{low:g}" for low, _ in ranges]
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation


def _corner_and_size(box: Array) -> list[float]:
    return [float(value) for value in (*box[:2], *(box[2:] - box[:2]))]


def _mean(precision: Array) -> float | None:
    known = precision[precision > -1]
    return round(float(known.mean()), 6) if known.size else None


def _known(value: float | None) -> str:
    return "unknown (nothing to find)" if value is None else f"{value:.3f}"


LOWEST_SCORE = 0.01  # score threshold; detections below it hardly change the average precision
FOUND, WANTED, NEUTRAL = "found", "wanted", "neutral"
CLASSES, SMALLEST = "classes", "smallest_px"


class SignsOutcomes:
    """Measure of the sign task: COCO's mAP at IoU 0.5."""

    measure_name = "mAP50"
    redraws = 200  # few, since each bootstrap sample matches all images again

    def describe_targets(self, config: SignsConfig) -> str:
        """Return the classes and the least size of a network's targets in words."""
        return f"{config.labels}: {', '.join(sorted(config.classes))} of {config.smallest_px:g} px or more"

    def share_targets(self, configs: Sequence[SignsConfig]) -> SignsConfig:
        """Return the first configuration with the classes and sizes of all; raises `InputError` for none in common."""
        classes = tuple(name for name in configs[0].classes if all(name in config.classes for config in configs))
        if not classes or len({config.labels for config in configs}) > 1:
            targets = "; ".join(map(self.describe_targets, configs))
            raise InputError(f"the networks look for nothing in common: {targets}")
        return replace(configs[0], classes=classes, smallest_px=max(config.smallest_px for config in configs))

    def outcomes(
        self,
        network: SignDetector,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: SignsConfig | None = None,
    ) -> Outcomes:
        """Return detections and ground truth of each image, flattened, with the counts per image.

        asked: a configuration with the classes and sizes that count; None: that of the network.
        """
        counted = asked or network.config
        config = replace(network.config, classes=counted.classes, smallest_px=counted.smallest_px)
        recorded = _last_asked_for(data, config, tuple(frames))
        # Classes that do not count get the number after the last one.
        number = np.array([[*counted.classes, name].index(name) for name in network.config.classes])
        found, truths = [], []
        for done, sample in enumerate(recorded, start=1):
            truths.append(SignTruth(sample.boxes, sample.label, sample.ignore))
            seen = detect_in_picture(network, sample.picture, threshold=LOWEST_SCORE)
            label = number[seen.label]
            kept = label < len(counted.classes)
            found.append(SignDetections(seen.box[kept], label[kept], seen.score[kept]))
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
            CLASSES: np.array(config.classes),
            SMALLEST: np.array(config.smallest_px),
        }
        return Outcomes(np.array([recorded.scene(number) for number in range(len(recorded))]), arrays)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return mAP at IoU 0.5 of each bootstrap sample; NaN without targets."""
        found, truths = by_picture(outcomes)
        classes = outcomes.arrays[CLASSES].tolist()
        smallest = float(outcomes.arrays[SMALLEST])
        values = []
        for counts in times:
            drawn = np.repeat(np.arange(len(counts)), counts)
            result = mean_average_precision([found[i] for i in drawn], [truths[i] for i in drawn], classes, smallest)
            values.append(np.nan if result.map50 is None else result.map50)
        return np.array(values, dtype=np.float64)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return mAP averaged over IoU 0.5 to 0.95, and the number of targets."""
        found, truths = by_picture(outcomes)
        classes = outcomes.arrays[CLASSES].tolist()
        smallest = float(outcomes.arrays[SMALLEST])
        result = mean_average_precision(found, truths, classes, smallest)
        return {"mAP50-95": result.map50_95, "targets": float(len(outcomes.arrays[f"{WANTED}/label"]))}


def by_picture(outcomes: Outcomes) -> tuple[list[SignDetections], list[SignTruth]]:
    """Return the detections and the ground truth, by image."""

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
    """Return the images with their labels, cached, since every validation of a training asks for the same ones."""
    return RecordedPictures(data, config, frames)
