"""IoU, complete IoU and non-maximum suppression of axis-aligned rectangles, rows x1, y1, x2, y2."""

import math

import torch
from torch import Tensor

TINY = 1e-7  # added to denominators


def iou(one: Tensor, other: Tensor) -> Tensor:
    """Return (N, M) intersection over union of rectangles (N, 4) with (M, 4)."""
    return _iou(one[:, None], other[None])


def complete_iou(one: Tensor, other: Tensor) -> Tensor:
    """Return (N,) complete IoU (CIoU) of rectangles (N, 4) with the rectangles of the same rows (N, 4), in (-1.5, 1].

    CIoU = IoU - d^2 / c^2 - a v: d the distance of the centres, c the diagonal of the smallest rectangle around both,
    v the difference of the aspect ratios, a its weight, a constant for derivatives (Zheng et al., "Distance-IoU Loss",
    AAAI 2020, eq. 7-11).
    """
    overlap = _iou(one, other)
    hull = torch.maximum(one[:, 2:], other[:, 2:]) - torch.minimum(one[:, :2], other[:, :2])
    apart = (one[:, :2] + one[:, 2:] - other[:, :2] - other[:, 2:]) / 2
    distance = apart.square().sum(1) / (hull.square().sum(1) + TINY)
    shape = (4 / math.pi**2) * (_slant(one) - _slant(other)).square()
    with torch.no_grad():
        weight = shape / (1 - overlap + shape + TINY)
    return overlap - distance - weight * shape


def nms(boxes: Tensor, scores: Tensor, most: float) -> Tensor:
    """Return the indices of the rectangles (N, 4) that non-maximum suppression keeps, highest of the scores (N,) first.

    A rectangle is dropped where its IoU with a kept one of higher score exceeds `most`.
    """
    order = scores.argsort(descending=True, stable=True)
    overlaps = iou(boxes[order], boxes[order]) > most
    kept = torch.ones(len(order), dtype=torch.bool)
    for i in range(len(order)):
        if kept[i]:
            kept[i + 1 :] &= ~overlaps[i, i + 1 :].cpu()
    return order[kept.to(order.device)]


def _iou(one: Tensor, other: Tensor) -> Tensor:
    low, high = torch.maximum(one[..., :2], other[..., :2]), torch.minimum(one[..., 2:], other[..., 2:])
    common = (high - low).clamp(min=0).prod(-1)
    areas = (one[..., 2:] - one[..., :2]).prod(-1) + (other[..., 2:] - other[..., :2]).prod(-1)
    return common / (areas - common + TINY)


def _slant(boxes: Tensor) -> Tensor:
    width, height = (boxes[:, 2:] - boxes[:, :2]).unbind(1)
    return torch.atan(width / (height + TINY))
