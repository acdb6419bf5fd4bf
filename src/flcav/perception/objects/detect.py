"""Boxes from point clouds."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.objects.anchors import anchor_boxes, anchor_classes
from flcav.perception.objects.batch import predict
from flcav.perception.objects.model import Second
from flcav.perception.objects.targets import decode
from flcav.perception.ops.rotated import nms

CANDIDATES = 256  # best-scoring anchors per class that suppression looks at


def detect(network: Second, points: NDArray[np.float32], *, score_threshold: float = 0.1) -> Boxes:
    """Return the boxes found in a point cloud (N, 4), LiDAR frame, best score first within a class."""
    return detect_all(network, [points], score_threshold=score_threshold)[0]


def detect_all(
    network: Second, clouds: Sequence[NDArray[np.float32]], *, score_threshold: float = 0.1, batch: int = 4
) -> list[Boxes]:
    """Return `detect` of every point cloud; the network's mode is left as it was."""
    training = network.training
    network.eval()
    found: list[Boxes] = []
    with torch.inference_mode():
        for first in range(0, len(clouds), batch):
            output = predict(network, clouds[first : first + batch])
            score = output.score.sigmoid().cpu().numpy()
            box = output.box.double().cpu().numpy()
            direction = output.direction.argmax(2).cpu().numpy()
            found += [_boxes(network, *one, score_threshold) for one in zip(score, box, direction, strict=True)]
    network.train(training)
    return found


def _boxes(network: Second, score: NDArray, box: NDArray, direction: NDArray, threshold: float) -> Boxes:
    config = network.config
    parts = []
    for index, name in enumerate(config.classes):
        own = np.flatnonzero(anchor_classes(config) == index)
        scores = score[own, index]
        likely = np.argsort(-scores, kind="stable")[:CANDIDATES]
        likely = likely[scores[likely] >= threshold]
        own, scores = own[likely], scores[likely]
        rows = decode(box[own], direction[own], anchor_boxes(config)[own])
        kept = nms(torch.from_numpy(rows), torch.from_numpy(scores)).numpy()
        parts.append(Boxes.from_array(rows[kept], name, scores[kept]))
    return concatenate(parts)
