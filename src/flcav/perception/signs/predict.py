"""Inference of the sign detector: decoding, score threshold and class-agnostic non-maximum suppression."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.perception.device import autocast_bfloat16
from flcav.perception.images import Picture
from flcav.perception.ops.rectangles import nms
from flcav.perception.signs.augment import GREY
from flcav.perception.signs.config import STRIDES
from flcav.perception.signs.model import SignDetector, decode
from flcav.perception.signs.samples import Sample
from flcav.perception.signs.targets import assign_anchors
from flcav.perception.task import Result
from flcav.storage.records import Class

CANDIDATES = 512  # number of best-scoring anchors before non-maximum suppression
MOST_OVERLAP = 0.5  # IoU above which the lower-scoring of two boxes is suppressed, whatever their classes
MOST_FOUND = 100  # largest number of detections of an image


@dataclass(frozen=True)
class SignDetections:
    """Detections in one image as arrays, by falling score."""

    box: NDArray[np.float64]  # (N, 4) x1 y1 x2 y2 [px] from the upper left corner
    label: NDArray[np.int64]  # (N,) index of the class
    score: NDArray[np.float64]  # (N,) in [0, 1]

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class BoxFound:
    """A detected sign or traffic light; coordinates are from the upper left corner of the image."""

    label: Class
    score: float  # [0, 1]
    x1: float  # [px]
    y1: float
    x2: float
    y2: float


@dataclass(frozen=True)
class BoxesFound(Result):
    """The detected signs and traffic lights of an image, by falling score."""

    boxes: tuple[BoxFound, ...]

    def lines(self) -> list[str]:
        """Return the number of boxes, then one line per box."""
        lines = [f"{len(self.boxes)} box{'' if len(self.boxes) == 1 else 'es'}"]
        for box in self.boxes:
            corners = f"({box.x1:.1f}, {box.y1:.1f}) to ({box.x2:.1f}, {box.y2:.1f}) px"
            lines.append(f"{box.label:<14}{box.score:.2f}  {corners}")
        return lines


def boxes_found(found: SignDetections, classes: Sequence[str]) -> BoxesFound:
    """Return detections as a record with the names of their classes."""
    rows = zip(found.box.tolist(), map(int, found.label), map(float, found.score), strict=True)
    return BoxesFound(tuple(BoxFound(classes[label], score, *box) for box, label, score in rows))


def detect(network: SignDetector, picture: Picture, *, threshold: float) -> SignDetections:
    """Return the detections in an image of any size with a score of at least `threshold`.

    The network's training mode is left as it was.
    """
    training = network.training
    network.eval()
    with torch.inference_mode():
        raw = predict(network, [pad_to_stride(picture)])
        cells = [
            torch.cat((decode(maps, level, network.config), maps[..., 4:].sigmoid()), -1)[0].flatten(0, 2)
            for level, maps in enumerate(raw)
        ]
        found = _chosen(torch.cat(cells), threshold, picture)
    network.train(training)
    return found


def class_probabilities(network: SignDetector, samples: Sequence[Sample]) -> list[NDArray[np.float32]]:
    """Return the class probabilities (boxes, classes) of the boxes of each sample; sides are multiples of 32.

    A box has the mean of the anchors that it is assigned to in training, and zeros where there are none. The network's
    training mode is left as it was.
    """
    training, found = network.training, []
    network.eval()
    with torch.inference_mode():
        for sample in samples:
            total, count = (
                torch.zeros(len(sample.boxes), len(network.config.classes)),
                torch.zeros(len(sample.boxes), 1),
            )
            numbered = replace(sample, label=np.arange(len(sample.boxes)))
            for maps, at in zip(
                predict(network, [sample.picture]), assign_anchors([numbered], network.config), strict=True
            ):
                shares = maps[at.image, at.anchor, at.row, at.column, 5:].sigmoid().cpu()
                total.index_add_(0, at.label, shares)
                count.index_add_(0, at.label, torch.ones(len(at.label), 1))
            found.append((total / count.clamp(min=1)).numpy())
    network.train(training)
    return found


def pad_to_stride(picture: Picture) -> Picture:
    """Return the image padded with grey on the right and below, to sides that are multiples of the largest stride."""
    down, across = (-side % STRIDES[-1] for side in picture.shape[:2])
    return np.pad(picture, ((0, down), (0, across), (0, 0)), constant_values=GREY)


def predict(network: SignDetector, pictures: Sequence[Picture]) -> list[torch.Tensor]:
    """Return the network's raw predictions on images of one size, whose sides are multiples of the largest stride.

    One tensor per level as `SignDetector.forward`, in float32. Channels are last in memory and convolutions are in
    bfloat16 where the hardware supports it, which halves the time.
    """
    device = next(network.parameters()).device
    stacked = torch.from_numpy(np.stack(pictures)).to(device)
    with autocast_bfloat16(device, wanted=True):
        raw = network(stacked.permute(0, 3, 1, 2).float() / 255)
    return [maps.float() for maps in raw]


def _chosen(cells: torch.Tensor, threshold: float, picture: Picture) -> SignDetections:
    share, label = cells[:, 5:].max(1)
    score = share * cells[:, 4]
    likely = score.topk(min(CANDIDATES, len(score))).indices
    likely = likely[score[likely] >= threshold]
    height, width = picture.shape[:2]
    box = cells[likely, :4].clamp(min=0).minimum(cells.new_tensor([width, height, width, height]))
    kept = nms(box, score[likely], MOST_OVERLAP)[:MOST_FOUND]
    chosen = likely[kept]
    return SignDetections(
        box[kept].double().cpu().numpy(), label[chosen].cpu().numpy(), score[chosen].double().cpu().numpy()
    )
