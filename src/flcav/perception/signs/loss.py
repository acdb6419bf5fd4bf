"""The loss of the detector: complete IoU of boxes, cross entropies of objectness and class."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from flcav.perception.ops.rectangles import complete_iou
from flcav.perception.signs.config import STRIDES, SignsConfig
from flcav.perception.signs.model import boxes_of
from flcav.perception.signs.targets import Targets

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
