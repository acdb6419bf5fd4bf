"""The loss of the sign detector, and which cells answer for which sign."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from flcav.perception.ops.rectangles import complete_iou
from flcav.perception.signs.config import STRIDES, SignsConfig
from flcav.perception.signs.model import boxes_of
from flcav.perception.signs.samples import Sample

MOST_TIMES = 4.0  # by which a box's width and height may differ from its anchor's: what `decode` can reach


@dataclass(frozen=True)
class Targets:
    """What one level of a batch is to predict at P places."""

    image: Tensor  # (P,)
    anchor: Tensor  # (P,)
    row: Tensor  # (P,)
    column: Tensor  # (P,)
    box: Tensor  # (P, 4) x1 y1 x2 y2 [px]
    label: Tensor  # (P,)
    counted: Tensor  # (B, rows, columns) whether a cell's objectness is asked for


def assign(samples: Sequence[Sample], config: SignsConfig) -> list[Targets]:
    """Return the targets at each of `STRIDES` for pictures of one size.

    A box is assigned to every anchor whose width and height are within a factor of four of its own, in the cell of its
    centre and in the nearer neighbour to the side and above or below. Cells within ignored boxes are not counted.
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
            Targets(
                torch.from_numpy(image)[number], anchor, cell[:, 1], cell[:, 0], box[number], label[number], counted
            )
        )
    return levels


def _places(box: Tensor, anchors: Tensor, stride: int, grid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (P,) box, (P,) anchor, (P, 2) column and row of every assignment."""
    ratio = (box[:, 2:] - box[:, :2])[:, None] / anchors  # (N, A, 2)
    number, anchor = (torch.maximum(ratio, 1 / ratio).amax(2) < MOST_TIMES).nonzero(as_tuple=True)
    center = ((box[:, :2] + box[:, 2:]) / 2 / stride)[number]
    own = torch.minimum(center.long(), grid - 1)
    toward = torch.where(center - own < 0.5, -1, 1)  # the nearer neighbour along each axis
    steps = torch.stack((torch.zeros_like(toward), toward * torch.tensor([1, 0]), toward * torch.tensor([0, 1])))
    cell = own + steps  # (3, P, 2)
    inside = ((cell >= 0) & (cell < grid)).all(2)
    return number.expand(3, -1)[inside], anchor.expand(3, -1)[inside], cell[inside]


def _counted(sample: Sample, stride: int, grid: Tensor) -> Tensor:
    counted = torch.ones(int(grid[1]), int(grid[0]), dtype=torch.bool)
    for x1, y1, x2, y2 in sample.ignore / stride:
        counted[int(y1) : int(np.ceil(y2)), int(x1) : int(np.ceil(x2))] = False
    return counted


BOX, OBJECT, CLASS = 1.0, 10.0, 8.0  # weights of the parts
LEVELS = (4.0, 1.0, 0.4)  # of objectness: finer levels have more cells, of which fewer hold an object


def detection_loss(raw: Sequence[Tensor], targets: Sequence[Targets], config: SignsConfig) -> Tensor:
    """Return the loss of raw predictions at each stride.

    Boxes: mean of 1 - complete IoU over assigned places. Objectness: its target is that IoU where a place is assigned
    (the best, where several boxes share one) and 0 elsewhere; mean over counted cells. Classes: mean over assigned
    places, each class by itself.
    """
    total = raw[0].new_zeros(())
    for level, (cells, asked) in enumerate(zip(raw, targets, strict=True)):
        asked = _on(asked, cells.device)
        wanted = torch.zeros_like(cells[..., 4])
        counted = asked.counted[:, None].expand_as(wanted).clone()
        if len(asked.image):
            place = (asked.image, asked.anchor, asked.row, asked.column)
            found = cells[place]
            anchor = cells.new_tensor(config.anchors_px[level])[asked.anchor]
            cell = torch.stack((asked.column, asked.row), 1)
            overlap = complete_iou(boxes_of(found[:, :4], cell, anchor, STRIDES[level]), asked.box)
            label = functional.one_hot(asked.label, len(config.classes)).to(found)
            total = total + BOX * (1 - overlap).mean()
            total = total + CLASS * functional.binary_cross_entropy_with_logits(found[:, 5:], label)
            wanted = _largest_at(wanted, place, overlap.detach().clamp(min=0))
            counted[place] = True
        each = functional.binary_cross_entropy_with_logits(cells[..., 4], wanted, reduction="none")
        total = total + OBJECT * LEVELS[level] * (each * counted).sum() / counted.sum().clamp(min=1)
    return total


def _largest_at(maps: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Return `maps` with, at each place, the largest of the values given for it."""
    flat = torch.zeros_like(place[0])
    for index, size in zip(place, maps.shape, strict=True):
        flat = flat * size + index
    return maps.flatten().scatter_reduce(0, flat, values, "amax").view_as(maps)


def _on(targets: Targets, device: torch.device) -> Targets:
    return Targets(**{name: tensor.to(device) for name, tensor in vars(targets).items()})
