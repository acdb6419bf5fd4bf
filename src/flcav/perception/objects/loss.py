"""Anchors, training targets and loss of SECOND: focal loss, smooth L1 of box residuals, cross-entropy of directions.

There is one anchor per class and heading at the centre of every cell of the head's grid. Anchors are matched by IoU in
bird's-eye view after turning boxes to the nearest axis (Yan et al. 2018, sec. 3.2: for cars positive from 0.6, negative
below 0.45); the best anchors of an object are positive even below that. Residuals are those of Zhou and Tuzel,
"VoxelNet", CVPR 2018, eq. 1.

Loss: Yan et al. 2018, sec. 3.3, eqs. 1-4: the error of the yaw enters by its sine. Weights are the published 1 for
classes and 2 for boxes; the direction's is 1 instead of 0.2, since with the published one a third of the detected cars
have a reversed heading: front and back differ by few points.

Predicted variances are trained by the Gaussian negative log-likelihood of the residuals' errors (the variance's part of
He et al., "Bounding Box Regression with Uncertainty", CVPR 2019, eq. 9). The errors are detached, so that this term
does not change the boxes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from flcav.arrays import Array, Array32, Ints, Mask
from flcav.geometry import heading_vectors
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import HEADINGS, LOG_VARIANCES, SPEED_M_S, HeadOutput, head_shape
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import in_range

IGNORE_IOU = 0.1  # an anchor is ignored where its IoU with an ignored box exceeds this
IGNORE_MARGIN_M = 0.5  # and where its centre lies in an ignored box enlarged by this on each side


def cell_size(config: SecondConfig) -> tuple[float, float]:
    """Return the size of a cell of the head's grid along x and y [m]."""
    rows, columns = head_shape(config)
    x0, y0, _, x1, y1, _ = config.range_m
    return (x1 - x0) / columns, (y1 - y0) / rows


@lru_cache(maxsize=4)
def anchor_boxes(config: SecondConfig) -> Array:
    """Return the anchors (A, 7), rows x, y, z, length, width, height [m], yaw [rad], LiDAR frame; read-only.

    They are ordered by row, column, class, heading; A = rows * columns * classes * headings.
    """
    rows, columns = head_shape(config)
    dx, dy = cell_size(config)
    boxes = np.zeros((rows, columns, len(config.anchors), HEADINGS, 7))
    boxes[..., 0] = (config.range_m[0] + (np.arange(columns) + 0.5) * dx)[None, :, None, None]
    boxes[..., 1] = (config.range_m[1] + (np.arange(rows) + 0.5) * dy)[:, None, None, None]
    for index, anchor in enumerate(config.anchors):
        boxes[:, :, index, :, 2] = config.ground_z_m + anchor.height_m / 2
        boxes[:, :, index, :, 3:6] = anchor.length_m, anchor.width_m, anchor.height_m
    boxes[..., 1, 6] = np.pi / 2
    flat = boxes.reshape(-1, 7)
    flat.flags.writeable = False
    return flat


@lru_cache(maxsize=4)
def anchor_classes(config: SecondConfig) -> Ints:
    """Return the class indices (A,) of the anchors, in the order of `anchor_boxes`; read-only."""
    rows, columns = head_shape(config)
    classes = np.tile(np.repeat(np.arange(len(config.anchors)), HEADINGS), rows * columns)
    classes.flags.writeable = False
    return classes


@dataclass(frozen=True)
class Targets:
    """Training targets of a sample with A anchors, P of them positive."""

    positive: Tensor  # (P,) int64 indices of the positive anchors
    weight: Tensor  # (A,) float32: 1 for positive and negative anchors, 0 for ignored ones
    residual: Tensor  # (P, 7) float32, see `encode_residuals`
    exact: Tensor  # (P,) float32: 1 where residual and direction are learned, else 0
    direction: Tensor  # (P,) int64 direction class: 1 where the yaw is in [-3/4 pi, pi/4), else 0
    variance: Tensor | None = None  # (P, 7) float32 of the residuals, where boxes have one
    speed: Tensor | None = None  # (P,) float32 over ground, along the heading [m/s], where boxes have one; NaN: unknown


def encode_residuals(boxes: Array, anchors: Array) -> Array:
    """Return the residuals (P, 7) of boxes (P, 7) from anchors (P, 7) (VoxelNet, eq. 1).

    With d the diagonal of the anchor's footprint and its height h_a: (x - x_a) / d, (y - y_a) / d, (z - z_a) / h_a,
    logarithms of the ratios of length, width and height, yaw - yaw_a.
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
    plane = (boxes[:, :2] - anchors[:, :2]) / diagonal
    height = (boxes[:, 2] - anchors[:, 2]) / anchors[:, 5]
    size = np.log(boxes[:, 3:6] / anchors[:, 3:6])
    return np.concatenate((plane, height[:, None], size, (boxes[:, 6] - anchors[:, 6])[:, None]), 1)


def decode_residuals(residual: Array, direction: Ints, anchors: Array) -> Array:
    """Return the boxes (P, 7) of residuals (P, 7), direction classes (P,) and anchors (P, 7); yaw in [-pi, pi).

    The inverse of `encode_residuals` where `direction` is the class of the box's yaw. Logarithms of size ratios are
    clipped to [-2, 2].
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
    plane = residual[:, :2] * diagonal + anchors[:, :2]
    height = residual[:, 2] * anchors[:, 5] + anchors[:, 2]
    size = np.exp(np.clip(residual[:, 3:6], -2, 2)) * anchors[:, 3:6]
    axis = np.mod(residual[:, 6] + anchors[:, 6] - np.pi / 4, np.pi) + np.pi / 4
    yaw = np.mod(axis + np.pi * direction + np.pi, 2 * np.pi) - np.pi
    return np.concatenate((plane, height[:, None], size, yaw[:, None]), 1)


def decode_variance(variance: Array, boxes: Array, anchors: Array) -> Array:
    """Return the variances (P, 7) of decoded boxes [m^2, rad^2] from the variances (P, 7) of their residuals.

    First-order error propagation: a size is the exponential of its residual, the others are linear in theirs.
    """
    return variance * _slopes(boxes, anchors) ** 2


def encode_variance(variance: Array, boxes: Array, anchors: Array) -> Array:
    """Return the variances (P, 7) of residuals from those of boxes [m^2, rad^2]: the inverse of `decode_variance`."""
    return variance / _slopes(boxes, anchors) ** 2


def _slopes(boxes: Array, anchors: Array) -> Array:
    """Return the derivatives (P, 7) of decoded boxes with respect to their residuals."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    return np.column_stack((diagonal, diagonal, anchors[:, 5], boxes[:, 3:6], np.ones(len(boxes))))


def direction_of(yaw: Array) -> Ints:
    """Return the direction classes (P,) of yaws [rad]: 0 in [pi/4, 5/4 pi), else 1, to distinguish front from back."""
    return (np.mod(yaw - np.pi / 4, 2 * np.pi) >= np.pi).astype(np.int64)


def mark_free_cells(free: Array32, config: SecondConfig) -> Mask:
    """Return the mask (rows, columns) of cells of the head's grid that contain a free position (K, 2) x, y [m].

    Positions should be at most half a cell apart in a free area; otherwise cells of a rotated sample are missed.
    """
    rows, columns = head_shape(config)
    dx, dy = cell_size(config)
    column = np.floor((free[:, 0] - config.range_m[0]) / dx).astype(np.int64)
    row = np.floor((free[:, 1] - config.range_m[1]) / dy).astype(np.int64)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    mask = np.zeros((rows, columns), dtype=bool)
    mask[row[inside], column[inside]] = True
    return mask


def assign_anchors(sample: Sample, config: SecondConfig) -> Targets:
    """Return the training targets of a sample: positive, negative and ignored anchors, residuals, directions.

    An anchor is positive for the object of its class with the highest IoU, if that is at least the class's
    `matched_iou`, and for an object whose best anchor it is, if their IoU is above 0.1. Other anchors are ignored from
    `unmatched_iou` on, on boxes of `sample.ignore` or outside the range, and, where `sample.free` is given, in cells
    that are not known to be free. The rest are negative.
    """
    anchors, classes = anchor_boxes(config), anchor_classes(config)
    inside = in_range(sample.boxes, config)
    boxes, labels = sample.boxes.array()[inside], sample.boxes.label[inside]
    exact = np.ones(len(boxes), dtype=bool) if sample.exact is None else sample.exact[inside]
    counts = np.ones(len(anchors), dtype=bool)
    if sample.free is not None:
        counts &= np.repeat(mark_free_cells(sample.free, config).ravel(), HEADINGS * len(config.classes))
    ignored = np.concatenate((sample.ignore.array(), sample.boxes.array()[~inside]))
    counts[_find_ignored(ignored, config)] = False
    owner = np.full(len(anchors), -1)
    for index, anchor in enumerate(config.anchors):
        rows = np.flatnonzero(labels == anchor.name)
        near = _near(boxes[rows], config)
        near = near[classes[near] == index]
        if not len(rows) or not len(near):
            continue
        overlap = _axis_aligned_iou(anchors[near], boxes[rows])  # (near, rows)
        best, of = overlap.max(1), overlap.argmax(1)
        top = overlap.max(0)
        forced, forced_of = np.nonzero((overlap == top) & (top > 0.1))
        matched = best >= anchor.matched_iou
        matched[forced], of[forced] = True, forced_of
        counts[near[best >= anchor.unmatched_iou]] = False
        owner[near[matched]] = rows[of[matched]]
    positive = np.flatnonzero(owner >= 0)
    counts[positive] = True
    targets = boxes[owner[positive]]
    variance = None
    if sample.boxes.variance is not None:
        label_variance = sample.boxes.variance[inside][owner[positive]]
        variance = torch.from_numpy(encode_variance(label_variance, targets, anchors[positive]).astype(np.float32))
    speed = None
    if sample.boxes.speed is not None:
        speed = torch.from_numpy(sample.boxes.speed[inside][owner[positive]].astype(np.float32))
    return Targets(
        positive=torch.from_numpy(positive),
        weight=torch.from_numpy(counts.astype(np.float32)),
        exact=torch.from_numpy(exact[owner[positive]].astype(np.float32)),
        residual=torch.from_numpy(encode_residuals(targets, anchors[positive]).astype(np.float32)),
        direction=torch.from_numpy(direction_of(targets[:, 6])),
        variance=variance,
        speed=speed,
    )


def _near(boxes: Array, config: SecondConfig) -> Ints:
    """Return the indices of the anchors in cells near any box (B, 7): all those that may overlap one."""
    rows, columns = head_shape(config)
    dx, dy = cell_size(config)
    close = np.zeros((rows, columns), dtype=bool)
    longest = max(max(anchor.length_m, anchor.width_m) for anchor in config.anchors)
    for x, y, radius in zip(boxes[:, 0], boxes[:, 1], (np.hypot(boxes[:, 3], boxes[:, 4]) + longest) / 2, strict=True):
        row, column = (y - config.range_m[1]) / dy, (x - config.range_m[0]) / dx
        low_row, low_column = max(0, int(row - radius / dy)), max(0, int(column - radius / dx))
        close[low_row : max(0, int(row + radius / dy) + 1), low_column : max(0, int(column + radius / dx) + 1)] = True
    per_cell = HEADINGS * len(config.anchors)
    return (np.flatnonzero(close)[:, None] * per_cell + np.arange(per_cell)).ravel()


def _find_ignored(boxes: Array, config: SecondConfig) -> Ints:
    near = _near(boxes, config)
    if not len(near):
        return near
    anchors = anchor_boxes(config)[near]
    delta = anchors[:, None, :2] - boxes[None, :, :2]
    cos, sin = heading_vectors(boxes[:, 6]).T
    along = np.abs(delta[..., 0] * cos + delta[..., 1] * sin) <= boxes[:, 3] / 2 + IGNORE_MARGIN_M
    across = np.abs(delta[..., 1] * cos - delta[..., 0] * sin) <= boxes[:, 4] / 2 + IGNORE_MARGIN_M
    overlaps = _axis_aligned_iou(anchors, boxes) > IGNORE_IOU
    return near[((along & across) | overlaps).any(1)]


def _axis_aligned_iou(a: Array, b: Array) -> Array:
    """Return the IoU (A, B) in bird's-eye view of boxes a (A, 7) with b (B, 7), both turned to the nearest axis."""
    a_low, a_high = _axis_aligned(a)
    b_low, b_high = _axis_aligned(b)
    shared = np.minimum(a_high[:, None], b_high) - np.maximum(a_low[:, None], b_low)
    overlap = np.maximum(shared, 0).prod(-1)
    return overlap / ((a[:, 3] * a[:, 4])[:, None] + b[:, 3] * b[:, 4] - overlap)


def _axis_aligned(boxes: Array) -> tuple[Array, Array]:
    across = np.abs(np.sin(boxes[:, 6])) > np.sqrt(0.5)
    half = np.where(across[:, None], boxes[:, 4:2:-1], boxes[:, 3:5]) / 2
    return boxes[:, :2] - half, boxes[:, :2] + half


ALPHA, GAMMA = 0.25, 2.0  # of the focal loss
BOX_WEIGHT, DIRECTION_WEIGHT, VARIANCE_WEIGHT, SPEED_WEIGHT = 2.0, 1.0, 0.2, 1.0
SMOOTH_L1_BETA = 1 / 9  # error at which the smooth L1 loss turns from quadratic to linear


def second_loss(output: HeadOutput, targets: Sequence[Targets], config: SecondConfig) -> Tensor:
    """Return the scalar loss of a batch, the mean over its samples.

    The classification term of a sample is divided by its number of positive anchors; the box, direction and variance
    terms by its number of positive anchors with an exact box, the only ones that contribute to them.
    """
    share = torch.cat([target.exact / target.exact.sum().clamp(min=1) for target in targets]).to(output.score.device)
    box, direction, nll = box_losses(output, targets)
    total = BOX_WEIGHT * box.sum(1) + DIRECTION_WEIGHT * direction
    if nll is not None:
        total = total + VARIANCE_WEIGHT * nll.sum(1)
    if output.speed is not None:
        total = total + SPEED_WEIGHT * speed_loss(output.speed, _positive(output, targets), targets)
    return (classification_loss(output, targets, config) + (total * share).sum()) / len(targets)


def classification_loss(output: HeadOutput, targets: Sequence[Targets], config: SecondConfig) -> Tensor:
    """Return the sum over a batch's samples of their focal loss, divided by their number of positive anchors.

    Ignored anchors do not contribute.
    """
    device = output.score.device
    samples, anchors, classes = output.score.shape
    count = torch.tensor([max(len(target.positive), 1) for target in targets], device=device)
    positive = _positive(output, targets)
    weight = torch.stack([target.weight for target in targets]).to(device) / count[:, None]
    kind = torch.tensor(anchor_classes(config), device=device)[positive % anchors]
    logits = output.score.flatten()
    wanted = torch.zeros_like(logits)
    wanted[positive * classes + kind] = 1
    scores = focal_loss(logits, wanted).view(samples, anchors, classes).sum(2)
    return (scores * weight).sum()


def box_losses(output: HeadOutput, targets: Sequence[Targets]) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the losses of a batch's P positive anchors: residuals (P, 7), directions (P,) and variances (P, 7).

    They are smooth L1, cross-entropy and Gaussian negative log-likelihood; the last is None where none are predicted.
    """
    device = output.score.device
    positive = _positive(output, targets)
    residual = torch.cat([target.residual for target in targets]).to(device)
    error = residual_errors(output.box.flatten(0, 1)[positive], residual)
    box = smooth_l1(error)
    half_turn = torch.cat([target.direction for target in targets]).to(device)
    direction = F.cross_entropy(output.direction.flatten(0, 1)[positive], half_turn, reduction="none")
    if output.log_variance is None:
        return box, direction, None
    log_variance = output.log_variance.flatten(0, 1)[positive].clamp(*LOG_VARIANCES)
    return box, direction, gaussian_nll(error.detach(), log_variance)


def speed_loss(output: Tensor, positive: Tensor, targets: Sequence[Targets]) -> Tensor:
    """Return the smooth L1 loss (P,) of the speeds of positive anchors [SPEED_M_S]; 0 where a speed is unknown."""
    unknown = [torch.full((len(target.positive),), torch.nan) for target in targets]
    speeds = [none if target.speed is None else target.speed for target, none in zip(targets, unknown, strict=True)]
    error = output.flatten()[positive] - torch.cat(speeds).to(output.device) / SPEED_M_S
    return smooth_l1(error.nan_to_num())


def residual_errors(found: Tensor, wanted: Tensor) -> Tensor:
    """Return the errors (P, 7) of residuals (P, 7): differences, and for the yaw the sine of the difference."""
    error = found - wanted
    return torch.cat((error[:, :6], torch.sin(error[:, 6:])), 1)


def smooth_l1(error: Tensor) -> Tensor:
    """Return the smooth L1 loss of each error; shape of `error`."""
    return F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH_L1_BETA, reduction="none")


def _positive(output: HeadOutput, targets: Sequence[Targets]) -> Tensor:
    """Return the indices (P,) of the positive anchors of a batch among the anchors of all samples."""
    anchors = output.score.shape[1]
    return torch.cat([target.positive + i * anchors for i, target in enumerate(targets)]).to(output.score.device)


def gaussian_nll(error: Tensor, log_variance: Tensor) -> Tensor:
    """Return the Gaussian negative log-likelihood of each error, without its constant; shape of `error`."""
    return (error.square() * torch.exp(-log_variance) + log_variance) / 2


def focal_loss(logits: Tensor, wanted: Tensor) -> Tensor:
    """Return the focal loss of each logit (Lin et al., "Focal Loss for Dense Object Detection", eq. 5).

    wanted, in the shape of logits: 1 for positives, 0 for negatives.
    """
    signed = torch.where(wanted > 0, logits, -logits)
    balance = torch.where(wanted > 0, ALPHA, 1 - ALPHA)
    return -balance * torch.sigmoid(-signed) ** GAMMA * F.logsigmoid(signed)
