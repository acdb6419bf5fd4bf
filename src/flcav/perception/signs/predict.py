"""Inference of the sign detector: decoding, score threshold, class-agnostic non-maximum suppression, and findings.

Inputs are images from files, folders and datasets.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from flcav.arrays import Array, Ints
from flcav.config import InputError
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.perception.device import autocast_bfloat16, inference
from flcav.perception.images import Picture, read_pictures, read_recorded
from flcav.perception.marks import PictureBoxes
from flcav.perception.ops.boxes import rectangle_nms
from flcav.perception.signs.model import STRIDES, SignDetector, decode_level
from flcav.perception.signs.samples import GREY, check_stands, compare_with_background, learn_picture_background
from flcav.perception.task import Finding, Result
from flcav.storage.records import Class

CANDIDATES = 512  # number of best-scoring anchors before non-maximum suppression
MOST_OVERLAP = 0.5  # IoU above which the lower-scoring of two boxes is suppressed, whatever their classes
MOST_FOUND = 100  # largest number of detections of an image


@dataclass(frozen=True)
class SignDetections:
    """Detections in an image as arrays, by falling score."""

    box: Array  # (N, 4) x1 y1 x2 y2 [px] from the upper left corner
    label: Ints  # (N,) index of the class
    score: Array  # (N,) in [0, 1]

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class BoxFound:
    """A detected sign or traffic light; coordinates are from the upper left corner of the image [px]."""

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


def detect_in_picture(network: SignDetector, picture: Picture, *, threshold: float) -> SignDetections:
    """Return the detections in an image of any size with a score of at least `threshold`.

    The network's training mode is restored.
    """
    with inference(network):
        raw = predict_levels(network, [pad_to_stride(picture)])
        cells = [
            torch.cat((decode_level(maps, level, network.config), maps[..., 4:].sigmoid()), -1)[0].flatten(0, 2)
            for level, maps in enumerate(raw)
        ]
        found = _chosen(torch.cat(cells), threshold, picture)
    return found


def pad_to_stride(picture: Picture) -> Picture:
    """Return the image padded with grey at the right and bottom, to sides that are multiples of the largest stride."""
    down, across = (-side % STRIDES[-1] for side in picture.shape[:2])
    return np.pad(picture, ((0, down), (0, across), (0, 0)), constant_values=GREY)


def predict_levels(network: SignDetector, pictures: Sequence[Picture]) -> list[torch.Tensor]:
    """Return the network's raw predictions on images of one size, whose sides are multiples of the largest stride.

    There is one tensor per level, as in `SignDetector.forward`, in float32. Memory is channels-last, and convolutions
    are in bfloat16 where the hardware supports it, which halves the time.
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
    kept = rectangle_nms(box, score[likely], MOST_OVERLAP)[:MOST_FOUND]
    chosen = likely[kept]
    return SignDetections(
        box[kept].double().cpu().numpy(), label[chosen].cpu().numpy(), score[chosen].double().cpu().numpy()
    )


def detect_signs(
    network: SignDetector, path: Path, threshold: float, frames: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield the detections of score `threshold` or more in each image at `path`, by falling score.

    Raises `InputError` as `flcav.perception.images.read_pictures` does. A network of backgrounds detects only in
    pictures of a dataset's poles; it raises `InputError` for files, and for frames of vehicles.
    """
    for origin, rgb, seen in _read(network, path, frames):
        found = detect_in_picture(network, seen, threshold=threshold)
        names = np.array(network.config.classes)[found.label]
        marks = (PictureBoxes(found.box, names, found.score),)
        yield Finding(origin, rgb, boxes_found(found, network.config.classes), marks)


def _read(network: SignDetector, path: Path, frames: Sequence[int] | None) -> Iterator[tuple[Path, Picture, Picture]]:
    """Yield path and image, and the image in the form that the network sees."""
    if not network.config.background:
        yield from ((origin, rgb, rgb) for origin, rgb in read_pictures(path, frames))
        return
    if not (path / MANIFEST).is_file():
        raise InputError(f"{path}: this network sees pictures of poles beside their background; a dataset is wanted")
    data = Dataset.open(path)
    check_stands(data, data.numbers(frames))
    for frame, camera, rgb in read_recorded(data, frames):
        behind = learn_picture_background(data, frame.agent, camera)
        yield path / f"{frame.key}/{camera}", rgb, compare_with_background(rgb, behind)
