"""Loss of the sign detector: complete IoU of boxes, and binary cross entropies of objectness and classes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from flcav.perception.ops.rectangles import complete_iou
from flcav.perception.signs.config import STRIDES, SignsConfig
from flcav.perception.signs.model import SignDetector, decode_boxes
from flcav.perception.signs.predict import predict
from flcav.perception.signs.samples import Sample
from flcav.perception.signs.targets import Targets, assign_anchors

BOX, OBJECT, CLASS = 1.0, 10.0, 8.0  # weights of the terms
LEVELS = (4.0, 1.0, 0.4)  # weights of the levels' objectness: on finer levels a smaller share of cells has an object


def batch_loss(network: SignDetector, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of `network` on images of one size, whose sides are multiples of 32; see `detection_loss`."""
    raw = predict(network, [sample.picture for sample in samples])
    return detection_loss(raw, assign_anchors(samples, network.config), network.config)


def imitation_loss(network: SignDetector, samples: Sequence[Sample], targets: Sequence[NDArray[np.float32]]) -> Tensor:
    """Return the loss of a batch whose boxes have class probabilities (boxes, classes) instead of labels."""
    raw, classes = predict(network, [sample.picture for sample in samples]), torch.from_numpy(np.concatenate(targets))
    return detection_loss(raw, assign_anchors(number_boxes(samples), network.config), network.config, classes)


def number_boxes(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples with the number of each box among all of them for a label."""
    ends = np.cumsum([len(sample.boxes) for sample in samples])
    return [
        replace(sample, label=np.arange(end - len(sample.boxes), end))
        for sample, end in zip(samples, ends, strict=True)
    ]


def detection_loss(
    raw: Sequence[Tensor], targets: Sequence[Targets], config: SignsConfig, classes: Tensor | None = None
) -> Tensor:
    """Return the loss of raw predictions, one tensor per level as `SignDetector.forward`: the weighted sum of terms.

    Boxes: mean of 1 - complete IoU over the assigned anchors. Objectness: mean binary cross entropy over counted
    cells; the target is that complete IoU at assigned anchors (the largest, if several boxes share one) and 0
    elsewhere. Classes: mean binary cross entropy over assigned anchors and classes; `classes` (labels, classes) are the
    probabilities that a label stands for, by default 1 of its own class.
    """
    classes = torch.eye(len(config.classes)) if classes is None else classes
    total = raw[0].new_zeros(())
    for level, (cells, asked) in enumerate(zip(raw, targets, strict=True)):
        asked = _to_device(asked, cells.device)
        wanted = torch.zeros_like(cells[..., 4])
        counted = asked.counted[:, None].expand_as(wanted).clone()
        if len(asked.image):
            place = (asked.image, asked.anchor, asked.row, asked.column)
            found = cells[place]
            anchor = cells.new_tensor(config.anchors_px[level])[asked.anchor]
            cell = torch.stack((asked.column, asked.row), 1)
            overlap = complete_iou(decode_boxes(found[:, :4], cell, anchor, STRIDES[level]), asked.box)
            label = classes.to(found)[asked.label]
            total = total + BOX * (1 - overlap).mean()
            total = total + CLASS * functional.binary_cross_entropy_with_logits(found[:, 5:], label)
            wanted = _largest_at(wanted, place, overlap.detach().clamp(min=0))
            counted[place] = True
        each = functional.binary_cross_entropy_with_logits(cells[..., 4], wanted, reduction="none")
        total = total + OBJECT * LEVELS[level] * (each * counted).sum() / counted.sum().clamp(min=1)
    return total


def _largest_at(maps: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Return `maps` with each entry raised to the largest of the values at its index in `place`."""
    flat = torch.zeros_like(place[0])
    for index, size in zip(place, maps.shape, strict=True):
        flat = flat * size + index
    return maps.flatten().scatter_reduce(0, flat, values, "amax").view_as(maps)


def _to_device(targets: Targets, device: torch.device) -> Targets:
    return Targets(**{name: tensor.to(device) for name, tensor in vars(targets).items()})
