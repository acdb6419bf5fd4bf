"""Training targets of the sign detector: assignment of boxes to anchors and cells at each level."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flcav.perception.signs.config import STRIDES, SignsConfig
from flcav.perception.signs.samples import Sample

MOST_TIMES = 4.0  # largest ratio of a box's width or height to its anchor's, either way; `decode` reaches no more


@dataclass(frozen=True)
class Targets:
    """Training targets of a batch at one level: P pairs of a box with an anchor of a cell."""

    image: Tensor  # (P,) index in the batch
    anchor: Tensor  # (P,) index of the anchor
    row: Tensor  # (P,) of the cell
    column: Tensor  # (P,) of the cell
    box: Tensor  # (P, 4) x1 y1 x2 y2 [px]
    label: Tensor  # (P,) index of the class
    counted: Tensor  # (B, rows, columns) whether a cell enters the objectness loss


def assign_anchors(samples: Sequence[Sample], config: SignsConfig) -> list[Targets]:
    """Return the training targets at each of `STRIDES` for images of one size.

    A box is assigned to every anchor whose width and height are within a factor of four of its own, in the cell of its
    centre and in the nearer horizontal and the nearer vertical neighbour. Cells within ignored boxes do not count.
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
    """Return box (P,), anchor (P,), and cell (P, 2) as column, row, of every assignment."""
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
