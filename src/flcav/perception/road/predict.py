"""Inference of the road network: class probabilities, a class for every pixel, lane lines, and findings for drawing.

Inputs are images from files, folders and datasets; only those of datasets have a calibration, and so a ground plane.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from flcav.arrays import Array32, Bytes
from flcav.dataset.ground import DatasetGround
from flcav.dataset.layout import MANIFEST
from flcav.dataset.road_labels import ROAD_CLASSES
from flcav.dataset.store import Dataset
from flcav.interface.wording import plural
from flcav.perception.device import autocast_bfloat16, inference
from flcav.perception.images import Picture, read_pictures, read_recorded
from flcav.perception.marks import GroundLines, PictureClasses, PictureLines
from flcav.perception.road.lines import GroundPlane, TracedLine, trace_lines
from flcav.perception.road.model import LARGEST_STRIDE, STRIDE, RoadNetwork, enlarge
from flcav.perception.road.samples import GREY
from flcav.perception.task import Finding, Result
from flcav.storage.records import LEFT_OUT, Class

DECIMALS = 2  # of coordinates in results


@dataclass(frozen=True)
class LineFound:
    """A lane line from its near end to its far end."""

    kind: str  # solid | broken
    score: float  # [0, 1]
    pixels: tuple[tuple[float, float], ...]  # u, v [px]; the centre of the first pixel is (0, 0)
    ground: Annotated[tuple[tuple[float, float], ...] | None, LEFT_OUT] = None
    # x forward, y left of the agent on its ground plane [m]; None without a calibration


@dataclass(frozen=True)
class RoadFound(Result):
    """The road in an image: the share of its pixels of each class, and the lane lines, longest first."""

    shares: Mapping[Class, float]  # class -> share of the pixels
    lane_lines: tuple[LineFound, ...]

    def lines(self) -> list[str]:
        """Return the shares of the classes, then one line per lane line."""
        seen = ", ".join(f"{name} {share:.3f}" for name, share in self.shares.items() if share)
        lines = [f"{plural(len(self.lane_lines), 'lane line')}; pixels: {seen}"]
        for line in self.lane_lines:
            (u0, v0), (u1, v1) = line.pixels[0], line.pixels[-1]
            place = f"({u0:.0f}, {v0:.0f}) to ({u1:.0f}, {v1:.0f}) px"
            if line.ground is not None:
                (x0, y0), (x1, y1) = line.ground[0], line.ground[-1]
                place += f", ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m"
            lines.append(f"{line.kind:<8}{line.score:.2f}  {place}")
        return lines


def predict_logits(network: RoadNetwork, pictures: Sequence[Picture]) -> Tensor:
    """Return the network's logits (B, classes, H / 4, W / 4) on images of one size, sides multiples of 16, in float32.

    Convolutions are in bfloat16 where the hardware supports it, which halves the time.
    """
    device = next(network.parameters()).device
    stacked = torch.from_numpy(np.stack(pictures)).to(device)
    with autocast_bfloat16(device, wanted=True):
        logits = network(stacked.permute(0, 3, 1, 2).float() / 127.5 - 1)
    return logits.float()


def segment_picture(network: RoadNetwork, picture: Picture) -> tuple[Array32, Bytes]:
    """Return the class probabilities (classes, h, w) of cells of `STRIDE` pixels, and the class (H, W) of each pixel.

    The network's training mode is restored.
    """
    height, width = picture.shape[:2]
    down, across = (-side % LARGEST_STRIDE for side in (height, width))
    padded = np.pad(picture, ((0, down), (0, across), (0, 0)), constant_values=GREY)
    with inference(network):
        logits = predict_logits(network, [padded])
        classes = enlarge(logits, STRIDE)[0, :, :height, :width].argmax(0)
        shares = logits[0, :, : -(-height // STRIDE), : -(-width // STRIDE)].softmax(0)
    return shares.cpu().numpy(), classes.byte().cpu().numpy()


def find_roads(
    network: RoadNetwork, path: Path, threshold: float, frames: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield the road in each image at `path`, with the lane lines whose score is `threshold` or more.

    Raises `InputError` as `flcav.perception.images.read_pictures` does.
    """
    for origin, rgb, plane in _read(path, frames):
        shares, classes = segment_picture(network, rgb)
        traced = [line for line in trace_lines(shares, plane) if line.score >= threshold]
        kinds = tuple(_kind(line) for line in traced)
        marks = (
            PictureClasses(classes, ROAD_CLASSES),
            PictureLines(tuple(line.pixels for line in traced), kinds),
            *([GroundLines(tuple(line.ground for line in traced if line.ground is not None), kinds)] if plane else ()),
        )
        yield Finding(origin, rgb, _as_result(classes, traced), marks)


def _read(path: Path, frames: Sequence[int] | None) -> Iterator[tuple[Path, Picture, GroundPlane | None]]:
    if not (path / MANIFEST).is_file():
        yield from ((origin, rgb, None) for origin, rgb in read_pictures(path, frames))
        return
    data = Dataset.open(path)
    ground = DatasetGround(data)
    for frame, camera, rgb in read_recorded(data, frames):
        plane = GroundPlane.of(frame, camera, ground.height_of(data.number(frame.key)))
        yield path / f"{frame.key}/{camera}", rgb, plane


def _kind(line: TracedLine) -> str:
    return "solid" if line.solid else "broken"


def _as_result(classes: Bytes, traced: Sequence[TracedLine]) -> RoadFound:
    counts = np.bincount(classes.ravel(), minlength=len(ROAD_CLASSES)) / classes.size
    shares = {name: round(float(share), 6) for name, share in zip(ROAD_CLASSES, counts, strict=True)}
    return RoadFound(shares, tuple(_as_found(line) for line in traced))


def _as_found(line: TracedLine) -> LineFound:
    def pairs(points: np.ndarray) -> tuple[tuple[float, float], ...]:
        return tuple((round(u, DECIMALS), round(v, DECIMALS)) for u, v in points.tolist())

    ground = None if line.ground is None else pairs(line.ground)
    return LineFound(_kind(line), round(line.score, 4), pairs(line.pixels), ground)
