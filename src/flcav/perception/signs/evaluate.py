"""COCO's mean average precision of the sign detector, also by class and by size of the box."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from faster_coco_eval import COCO, COCOeval_faster
from numpy.typing import NDArray

from flcav.interface.wording import plural
from flcav.perception.signs.predict import SignDetections
from flcav.perception.signs.samples import size_px
from flcav.perception.task import Evaluated
from flcav.storage.records import Class

EDGES_PX = (12.0, 24.0)  # borders between small, medium and large, as roots of a box's area
LARGEST_PX = 1e5
ALL, FIFTY = 0, 0  # index of the area range of all sizes; index of the IoU threshold 0.5


@dataclass(frozen=True)
class SignTruth:
    """Ground truth of one image."""

    box: NDArray[np.float64]  # (N, 4) x1 y1 x2 y2 [px] of the targets
    label: NDArray[np.int64]  # (N,) index of the class
    neutral: NDArray[np.float64]  # (K, 4) boxes whose detection, as any class, is neither right nor wrong


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
    """Mean average precision of targets of one size, the root of a box's area; None without targets."""

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
    """COCO's mean average precision, as a whole, by class and by size; None without targets."""

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

    `found` and `truths` have an entry per image. Detections that are smaller than `smallest_px`, or match only a
    neutral box (COCO's "crowd": the intersection over the detection's area counts), are neither right nor wrong.
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


def _corner_and_size(box: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in (*box[:2], *(box[2:] - box[:2]))]


def _mean(precision: NDArray[np.float64]) -> float | None:
    known = precision[precision > -1]
    return round(float(known.mean()), 6) if known.size else None


def _known(value: float | None) -> str:
    return "unknown (nothing to find)" if value is None else f"{value:.3f}"
