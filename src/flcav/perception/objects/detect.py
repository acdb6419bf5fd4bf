"""Inference: boxes from point clouds, by decoding of anchors, score calibration and non-maximum suppression."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flcav.geometry import Boxes, concatenate
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.loss import LOG_VARIANCES, predict
from flcav.perception.objects.model import Second
from flcav.perception.objects.targets import anchor_boxes, anchor_classes, decode, decode_variance
from flcav.perception.ops.rotated import nms

CANDIDATES = 256  # anchors of highest score per class that enter non-maximum suppression


def detect(network: Second, points: NDArray[np.float32], *, score_threshold: float = 0.1) -> Boxes:
    """Return the boxes detected in a point cloud (N, 4) x, y, z [m], intensity [0, 1], LiDAR frame.

    They have class labels and scores of at least `score_threshold`, class by class, highest score first, and variances
    where the network predicts them.
    """
    return detect_all(network, [points], score_threshold=score_threshold)[0]


def detect_all(
    network: Second, clouds: Sequence[NDArray[np.float32]], *, score_threshold: float = 0.1, batch: int = 4
) -> list[Boxes]:
    """Return the boxes detected in each point cloud as `detect` does, `batch` clouds at a time.

    The network runs in evaluation mode; its mode is restored.
    """
    training = network.training
    network.eval()
    found: list[Boxes] = []
    with torch.inference_mode():
        for first in range(0, len(clouds), batch):
            output = predict(network, clouds[first : first + batch])
            score = calibrate_logits(output.score, network.config).sigmoid().cpu().numpy()
            box = output.box.double().cpu().numpy()
            direction = output.direction.argmax(2).cpu().numpy()
            spread = [None] * len(score)
            if output.log_variance is not None:
                spread = output.log_variance.double().clamp(*LOG_VARIANCES).exp().cpu().numpy()
            parts = zip(score, box, direction, spread, strict=True)
            found += [_decode_boxes(network, *one, score_threshold) for one in parts]
    network.train(training)
    return found


def calibrate_logits(logits: Tensor, config: SecondConfig) -> Tensor:
    """Return the calibrated logits (..., classes), whose sigmoid is the score; unchanged without a calibration."""
    if config.calibration is None:
        return logits
    factor, summand = logits.new_tensor(config.calibration).T
    return logits * factor + summand


def _decode_boxes(
    network: Second, score: NDArray, box: NDArray, direction: NDArray, spread: NDArray | None, threshold: float
) -> Boxes:
    config = network.config
    parts = []
    for index, name in enumerate(config.classes):
        own = np.flatnonzero(anchor_classes(config) == index)
        scores = score[own, index]
        likely = np.argsort(-scores, kind="stable")[:CANDIDATES]
        likely = likely[scores[likely] >= threshold]
        own, scores = own[likely], scores[likely]
        anchors = anchor_boxes(config)[own]
        rows = decode(box[own], direction[own], anchors)
        kept = nms(torch.from_numpy(rows), torch.from_numpy(scores)).numpy()
        found = Boxes.from_array(rows[kept], name, scores[kept])
        if spread is not None:
            found = replace(found, variance=decode_variance(spread[own][kept], rows[kept], anchors[kept]))
        parts.append(found)
    return concatenate(parts)
