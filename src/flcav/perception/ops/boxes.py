"""IoU and non-maximum suppression of rotated boxes, in 3D and in bird's-eye view, and of axis-aligned rectangles.

Boxes are rows x, y, z of the centre, length, width, height [m], yaw [rad], in any frame with z up; computation is in
float64. The intersection of two footprints is the convex hull of the corners of each that lie in the other and of the
crossings of their edges. Coordinates are relative to the midpoint of the pair, so that precision does not depend on the
distance from the origin. Rectangles are rows x1, y1, x2, y2 [px].
"""

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

Kind = Literal["3d", "bev"]  # IoU of volumes, or of footprints in bird's-eye view
PAIRS_AT_ONCE = 100_000  # bounds the memory of `iou`


def iou(a: Tensor, b: Tensor, kind: Kind = "3d") -> Tensor:
    """Return the IoU (A, B), in float64, of boxes a (A, 7) with boxes b (B, 7), of volumes or of footprints."""
    a, b = a.double(), b.double()
    out = a.new_zeros(len(a), len(b))
    reach_a, reach_b = a[:, 3:5].norm(dim=1) / 2, b[:, 3:5].norm(dim=1) / 2
    apart = (a[:, None, :2] - b[None, :, :2]).norm(dim=2)
    first, second = (apart < reach_a[:, None] + reach_b).nonzero(as_tuple=True)
    for i, j in zip(first.split(PAIRS_AT_ONCE), second.split(PAIRS_AT_ONCE), strict=True):
        out[i, j] = paired_iou(a[i], b[j], kind)
    return out


def paired_iou(a: Tensor, b: Tensor, kind: Kind = "3d") -> Tensor:
    """Return the IoU (P,), in float64, of boxes a (P, 7) with the same rows of b (P, 7)."""
    a, b = a.double(), b.double()
    shared = intersection_area(a, b)
    if kind == "bev":
        return shared / (a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4] - shared)
    top = torch.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = torch.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    shared = shared * (top - bottom).clamp(min=0)
    return shared / (a[:, 3:6].prod(1) + b[:, 3:6].prod(1) - shared)


def intersection_area(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection areas (P,) [m^2] of the footprints of boxes a (P, 7) and the same rows of b (P, 7)."""
    middle = (a[:, :2] + b[:, :2]) / 2
    a = torch.cat((a[:, :2] - middle, a[:, 2:]), 1)
    b = torch.cat((b[:, :2] - middle, b[:, 2:]), 1)
    corners_a, corners_b = _corners(a), _corners(b)
    crossings, crossed = _crossings(corners_a, corners_b)
    points = torch.cat((corners_a, corners_b, crossings), 1)  # (P, 24, 2)
    valid = torch.cat((_inside(corners_a, b), _inside(corners_b, a), crossed), 1)
    center = (points * valid[..., None]).sum(1) / valid.sum(1, keepdim=True).clamp(min=1)
    spokes = points - center[:, None]
    angle = torch.atan2(spokes[..., 1], spokes[..., 0]).masked_fill(~valid, 9.0)
    order = angle.argsort(1)
    spokes = spokes.gather(1, order[..., None].expand(-1, -1, 2))
    valid = valid.gather(1, order)
    spokes = torch.where(valid[..., None], spokes, spokes[:, :1])  # invalid points repeat the first and add no area
    return _cross(spokes, spokes.roll(-1, 1)).sum(1).abs() / 2


def nms(boxes: Tensor, scores: Tensor, *, overlap: float = 0.01, consider: int = 256, keep: int = 100) -> Tensor:
    """Return the indices of the boxes (N, 7) that non-maximum suppression keeps, highest of the scores (N,) first.

    A box is dropped where its bird's-eye IoU with a kept one of higher score exceeds `overlap`. The `consider` boxes of
    highest score are candidates, and at most `keep` are kept.
    """
    order = scores.argsort(descending=True, stable=True)[:consider]
    clash = (iou(boxes[order], boxes[order], "bev") > overlap).cpu().numpy()
    fallen = np.zeros(len(order), dtype=bool)
    kept: list[int] = []
    for i in range(len(order)):
        if not fallen[i] and len(kept) < keep:
            kept.append(i)
            fallen |= clash[i]
    return order[torch.tensor(kept, dtype=torch.int64, device=order.device)]


def _corners(boxes: Tensor) -> Tensor:
    """Return the corners (P, 4, 2) of footprints, counter-clockwise."""
    cos, sin = boxes[:, 6].cos()[:, None], boxes[:, 6].sin()[:, None]
    along = boxes[:, 3:4] / 2 * boxes.new_tensor([1, -1, -1, 1])
    across = boxes[:, 4:5] / 2 * boxes.new_tensor([1, 1, -1, -1])
    return torch.stack((boxes[:, :1] + along * cos - across * sin, boxes[:, 1:2] + along * sin + across * cos), 2)


def _inside(points: Tensor, boxes: Tensor) -> Tensor:
    # (P, K) whether points (P, K, 2) lie in the footprints of boxes (P, 7)
    delta = points - boxes[:, None, :2]
    cos, sin = boxes[:, 6].cos()[:, None], boxes[:, 6].sin()[:, None]
    along = delta[..., 0] * cos + delta[..., 1] * sin
    across = delta[..., 1] * cos - delta[..., 0] * sin
    return (along.abs() <= boxes[:, 3:4] / 2 + 1e-10) & (across.abs() <= boxes[:, 4:5] / 2 + 1e-10)


def _crossings(corners_a: Tensor, corners_b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the crossings (P, 16, 2) of the edges of two rectangles, and whether they exist (P, 16).

    `corners_a` and `corners_b` are (P, 4, 2).
    """
    edge_a = (corners_a.roll(-1, 1) - corners_a)[:, :, None]
    edge_b = (corners_b.roll(-1, 1) - corners_b)[:, None]
    gap = corners_b[:, None] - corners_a[:, :, None]
    area = _cross(edge_a, edge_b)
    skew = area.abs() > 1e-12
    area = torch.where(skew, area, torch.ones_like(area))
    on_a, on_b = _cross(gap, edge_b) / area, _cross(gap, edge_a) / area
    crossed = skew & (on_a >= 0) & (on_a <= 1) & (on_b >= 0) & (on_b <= 1)
    points = corners_a[:, :, None] + on_a[..., None] * edge_a
    return points.flatten(1, 2), crossed.flatten(1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


TINY = 1e-7  # added to denominators


def rectangle_iou(one: Tensor, other: Tensor) -> Tensor:
    """Return the intersection over union (N, M) of rectangles (N, 4) with (M, 4)."""
    return _iou(one[:, None], other[None])


def complete_iou(one: Tensor, other: Tensor) -> Tensor:
    """Return the complete IoU (CIoU) (N,), in (-1.5, 1], of rectangles (N, 4) with the same rows of others (N, 4).

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


def rectangle_nms(boxes: Tensor, scores: Tensor, most: float) -> Tensor:
    """Return the indices of the rectangles (N, 4) that non-maximum suppression keeps, highest of the scores (N,) first.

    A rectangle is dropped where its IoU with a kept one of higher score exceeds `most`.
    """
    order = scores.argsort(descending=True, stable=True)
    overlaps = rectangle_iou(boxes[order], boxes[order]) > most
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
