"""Targets and loss of the sign detector: boxes assigned to anchors; complete IoU, objectness and class entropies.

`class_probabilities` are a network's predictions for the same boxes, from which others learn (see `number_boxes`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from flcav.arrays import Array32
from flcav.perception.device import inference
from flcav.perception.ops.boxes import complete_iou
from flcav.perception.signs.model import STRIDES, SignDetector, SignsConfig, decode_boxes
from flcav.perception.signs.predict import predict_levels
from flcav.perception.signs.samples import Sample

MOST_TIMES = 4.0  # largest ratio of a box's width or height to its anchor's, either way; `decode_boxes` reaches no more


@dataclass(frozen=True)
class LevelTargets:
    """Training targets of a batch at one level: P pairs of a box with an anchor in a cell."""

    image: Tensor  # (P,) index in the batch
    anchor: Tensor  # (P,) index of the anchor
    row: Tensor  # (P,) of the cell
    column: Tensor  # (P,) of the cell
    box: Tensor  # (P, 4) x1 y1 x2 y2 [px]
    label: Tensor  # (P,) index of the class
    counted: Tensor  # (B, rows, columns) whether a cell enters the objectness loss


def assign_levels(samples: Sequence[Sample], config: SignsConfig) -> list[LevelTargets]:
    """Return the training targets at the levels of `STRIDES` for images of one size.

    A box is assigned to every anchor whose width and height are within a factor of four of the box's, in the cell of
    its centre and in the nearer horizontal and the nearer vertical neighbour. Cells within ignored boxes do not count.
    """
    height, width = samples[0].picture.shape[:2]
    image = np.repeat(np.arange(len(samples)), [len(sample.boxes) for sample in samples])
    box = torch.from_numpy(np.concatenate([sample.boxes for sample in samples])).float()
    label = torch.from_numpy(np.concatenate([sample.label for sample in samples]))
    levels = []
    for level, stride in enumerate(STRIDES):
        grid = torch.tensor([width // stride, height // stride])
        number, anchor, cell = _places(box, torch.tensor(config.anchors_px[level]), stride, grid)
        counted = torch.stack([_counted(sample, stride, grid) for sample in samples])
        levels.append(
            LevelTargets(
                torch.from_numpy(image)[number], anchor, cell[:, 1], cell[:, 0], box[number], label[number], counted
            )
        )
    return levels


def _places(box: Tensor, anchors: Tensor, stride: int, grid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the box (P,), anchor (P,), and cell (P, 2), as column and row, of all assignments."""
    ratio = (box[:, 2:] - box[:, :2])[:, None] / anchors  # (N, A, 2)
    number, anchor = (torch.maximum(ratio, 1 / ratio).amax(2) < MOST_TIMES).nonzero(as_tuple=True)
    center = ((box[:, :2] + box[:, 2:]) / 2 / stride)[number]
    home = torch.minimum(center.long(), grid - 1)
    toward = torch.where(center - home < 0.5, -1, 1)  # the nearer neighbour along each axis
    steps = torch.stack((torch.zeros_like(toward), toward * torch.tensor([1, 0]), toward * torch.tensor([0, 1])))
    cell = home + steps  # (3, P, 2)
    inside = ((cell >= 0) & (cell < grid)).all(2)
    return number.expand(3, -1)[inside], anchor.expand(3, -1)[inside], cell[inside]


def _counted(sample: Sample, stride: int, grid: Tensor) -> Tensor:
    counted = torch.ones(int(grid[1]), int(grid[0]), dtype=torch.bool)
    for x1, y1, x2, y2 in sample.ignore / stride:
        counted[int(y1) : int(np.ceil(y2)), int(x1) : int(np.ceil(x2))] = False
    return counted


BOX, OBJECT, CLASS = 1.0, 10.0, 8.0  # weights of the terms
LEVELS = (4.0, 1.0, 0.4)  # weights of the levels' objectness: on finer levels a smaller share of cells has an object


def number_boxes(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples, with the number of each box among all boxes as its label."""
    ends = np.cumsum([len(sample.boxes) for sample in samples])
    return [
        replace(sample, label=np.arange(end - len(sample.boxes), end))
        for sample, end in zip(samples, ends, strict=True)
    ]


def detection_loss(
    raw: Sequence[Tensor], targets: Sequence[LevelTargets], config: SignsConfig, classes: Tensor | None = None
) -> Tensor:
    """Return the loss of raw predictions, one tensor per level as in `SignDetector.forward`: the weighted sum of terms.

    Boxes: mean of 1 - complete IoU over the assigned anchors. Objectness: mean binary cross entropy over counted cells;
    the target is that complete IoU at assigned anchors (the largest, where boxes share an anchor) and 0 elsewhere.
    Classes: mean binary cross entropy over assigned anchors and classes; `classes` (labels, classes) are the
    probabilities that a label stands for, by default 1 for its class.
    """
    classes = torch.eye(len(config.classes)) if classes is None else classes
    total = raw[0].new_zeros(())
    for level, (cells, of_level) in enumerate(zip(raw, targets, strict=True)):
        of_level = _to_device(of_level, cells.device)
        wanted = torch.zeros_like(cells[..., 4])
        counted = of_level.counted[:, None].expand_as(wanted).clone()
        if len(of_level.image):
            place = (of_level.image, of_level.anchor, of_level.row, of_level.column)
            found = cells[place]
            anchor = cells.new_tensor(config.anchors_px[level])[of_level.anchor]
            cell = torch.stack((of_level.column, of_level.row), 1)
            overlap = complete_iou(decode_boxes(found[:, :4], cell, anchor, STRIDES[level]), of_level.box)
            label = classes.to(found)[of_level.label]
            total = total + BOX * (1 - overlap).mean()
            total = total + CLASS * functional.binary_cross_entropy_with_logits(found[:, 5:], label)
            wanted = _largest_at(wanted, place, overlap.detach().clamp(min=0))
            counted[place] = True
        entropy = functional.binary_cross_entropy_with_logits(cells[..., 4], wanted, reduction="none")
        total = total + OBJECT * LEVELS[level] * (entropy * counted).sum() / counted.sum().clamp(min=1)
    return total


def _largest_at(maps: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Return `maps` with each entry raised to the largest of the values at its index in `place`."""
    flat = torch.zeros_like(place[0])
    for index, size in zip(place, maps.shape, strict=True):
        flat = flat * size + index
    return maps.flatten().scatter_reduce(0, flat, values, "amax").view_as(maps)


def _to_device(targets: LevelTargets, device: torch.device) -> LevelTargets:
    return LevelTargets(**{name: tensor.to(device) for name, tensor in vars(targets).items()})


def class_probabilities(network: SignDetector, samples: Sequence[Sample]) -> list[Array32]:
    """Return the class probabilities (boxes, classes) of the boxes of each sample; sides are multiples of 32.

    A box has the mean over the anchors to which training assigns it, and zeros where there are none. The network's
    training mode is restored.
    """
    found = []
    with inference(network):
        for sample in samples:
            total, count = (
                torch.zeros(len(sample.boxes), len(network.config.classes)),
                torch.zeros(len(sample.boxes), 1),
            )
            numbered = replace(sample, label=np.arange(len(sample.boxes)))
            for maps, at in zip(
                predict_levels(network, [sample.picture]), assign_levels([numbered], network.config), strict=True
            ):
                shares = maps[at.image, at.anchor, at.row, at.column, 5:].sigmoid().cpu()
                total.index_add_(0, at.label, shares)
                count.index_add_(0, at.label, torch.ones(len(at.label), 1))
            found.append((total / count.clamp(min=1)).numpy())
    return found
