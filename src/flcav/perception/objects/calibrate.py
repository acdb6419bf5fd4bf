"""Score calibration by Platt scaling, and reliability of scores (ECE) and of predicted variances, per class."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flcav.geometry import Boxes
from flcav.perception.metrics import calibration_error, fit_logistic, match, round_or_none
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_frames
from flcav.perception.objects.truth import FrameTruth, select_class
from flcav.sensors.frame import Frame
from flcav.storage.records import Class

OVERLAP = 0.5  # 3D IoU from which a detection is a true positive


def calibrate(network: Second, frames: Iterable[Frame]) -> None:
    """Set the Platt scaling in the configuration of `network`, fitted per class on frames it was not trained on.

    See `flcav.perception.metrics.calibration.fit_logistic`.
    """
    network.config = replace(network.config, calibration=None)
    detections, truths = detect_frames(network, frames)
    fitted = []
    for name in network.config.classes:
        matches = _matches(detections, truths, name)
        fitted.append(fit_logistic(matches.score, matches.hit))
    network.config = replace(network.config, calibration=tuple(fitted))


@dataclass(frozen=True)
class Reliability:
    """Reliability of one class's scores and predicted variances; None without detections or variances."""

    label: Class
    detections: int  # true and false positives
    ece: float | None  # expected calibration error of the scores, in [0, 1]
    variance_ratio: float | None  # mean squared error of x and y of true positives / mean predicted variance


def measure_reliability(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str]
) -> tuple[Reliability, ...]:
    """Return calibration error and variance ratio per class; detections and truths run over the same frames.

    A variance ratio of 1 is calibrated, above 1 overconfident, below 1 underconfident.
    """
    rows = []
    for name in classes:
        matches = _matches(detections, truths, name)
        ece, ratio = calibration_error(matches.score, matches.hit), _variance_ratio(detections, truths, name)
        rows.append(Reliability(name, len(matches.score), round_or_none(ece), round_or_none(ratio)))
    return tuple(rows)


def _matches(detections: Sequence[Boxes], truths: Sequence[FrameTruth], name: str):
    found = [select_class(boxes, name) for boxes in detections]
    targets = [select_class(truth.targets, name) for truth in truths]
    return match(found, targets, [select_class(truth.neutral, name) for truth in truths], OVERLAP)


def _variance_ratio(detections: Sequence[Boxes], truths: Sequence[FrameTruth], name: str) -> float:
    error, variance = [0.0], [0.0]
    for boxes, truth in zip(detections, truths, strict=True):
        found, targets = select_class(boxes, name), select_class(truth.targets, name)
        if found.variance is None or not len(found):
            continue
        target = assign_targets(found, targets, OVERLAP)
        hit = target >= 0
        error += ((found.center[hit] - targets.center[target[hit]])[:, :2] ** 2).sum(1).tolist()
        variance += found.variance[hit, :2].sum(1).tolist()
    total = float(np.sum(variance))
    return float(np.sum(error)) / total if total else float("nan")
