"""A YOLOv5-style one-stage detector and its configurations: width, depth, classes, anchors, training windows.

A backbone of cross-stage partial stages (Wang et al., "CSPNet", CVPRW 2020), spatial pyramid pooling by repeated
max pooling (He et al., "Spatial Pyramid Pooling in Deep Convolutional Networks", ECCV 2014), a path-aggregation neck
(Liu et al., "Path Aggregation Network for Instance Segmentation", CVPR 2018), and anchors on three levels. Terven et
al., "A Comprehensive Review of YOLO Architectures", 2023, describe how the parts are combined, their widths and depths.
With 80 classes the configurations `n` and `s` have the published 1.87 M and 7.23 M parameters. The configuration `road`
of the same network detects cars, in the pictures of roadside cameras.
"""

import math
from typing import Annotated, Literal

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from flcav.dataset.rectangles import SIGNS

STRIDES = (8, 16, 32)  # [px] of the three levels' feature maps
Side = Annotated[float, Field(gt=0, le=8192)]
Size = tuple[Side, Side]  # width, height [px]
Window = Annotated[int, Field(ge=32, le=8192)]
Level = tuple[Size, Size, Size]

# Signs are about square, signal heads three times as high as wide.
ANCHORS_PX: tuple[Level, Level, Level] = (
    ((5.0, 8.0), (9.0, 10.0), (8.0, 20.0)),
    ((16.0, 17.0), (14.0, 34.0), (26.0, 27.0)),
    ((26.0, 62.0), (45.0, 47.0), (80.0, 90.0)),
)

# Cars some 10 to 60 m from a camera of 90 degrees on a pole are wider than high, seen from the front nearly square.
CAR_ANCHORS_PX: tuple[Level, Level, Level] = (
    ((14.0, 9.0), (22.0, 13.0), (36.0, 18.0)),
    ((34.0, 30.0), (56.0, 26.0), (62.0, 44.0)),
    ((100.0, 48.0), (110.0, 90.0), (210.0, 100.0)),
)


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class SignsConfig:
    """Configuration of a sign detector, which takes images of any size; lengths are in pixels of the image."""

    width: Annotated[float, Field(gt=0, le=4)]  # factor of the numbers of channels, see `signs.model.CHANNELS`
    depth: Annotated[float, Field(gt=0, le=4)]  # factor of the numbers of bottlenecks, see `signs.model.DEPTHS`
    labels: Literal["signs", "actors"] = "signs"  # what is to be found: a key of `flcav.dataset.rectangles.CLASSES`
    classes: Annotated[tuple[str, ...], Field(min_length=1)] = SIGNS  # of these labels, in the order of the scores
    anchors_px: tuple[Level, Level, Level] = ANCHORS_PX  # width, height of the anchors at each of STRIDES
    background: bool = False  # whether its input is a picture with the static background: see `signs.samples`
    window_px: tuple[Window, Window] = (320, 192)  # width, height of a training sample
    smallest_px: Annotated[float, Field(ge=0, le=8192)] = 6.0  # least size, square root of the area, of a target box


CONFIGURATIONS = {
    "n": SignsConfig(width=0.25, depth=0.33),
    "s": SignsConfig(width=0.5, depth=0.33),
    "road": SignsConfig(
        width=0.125,
        depth=0.33,
        labels="actors",
        classes=("car", "van"),
        anchors_px=CAR_ANCHORS_PX,
        background=True,
        smallest_px=10.0,
    ),
}


CHANNELS = (64, 128, 256, 512, 1024)  # after each downsampling, at width 1
DEPTHS = (3, 6, 9, 3)  # bottlenecks of the backbone's stages, at depth 1
NECK_DEPTH = 3  # bottlenecks of the neck's stages, at depth 1
EXPECTED_OBJECTS = 1e-3  # initial odds of the objectness


def unit(into: int, out: int, kernel: int = 1, stride: int = 1, padding: int | None = None) -> nn.Sequential:
    """Return a convolution with batch normalisation and SiLU; `padding` None keeps the size at stride 1."""
    padding = kernel // 2 if padding is None else padding
    convolution = nn.Conv2d(into, out, kernel, stride, padding, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out, eps=1e-3), nn.SiLU())


class Bottleneck(nn.Module):
    """A bottleneck: a 1 x 1 and a 3 x 3 convolution, with a residual connection if `shortcut`."""

    def __init__(self, channels: int, shortcut: bool) -> None:
        super().__init__()
        self.layers = nn.Sequential(unit(channels, channels), unit(channels, channels, 3))
        self.shortcut = shortcut

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape."""
        return maps + self.layers(maps) if self.shortcut else self.layers(maps)


class CrossStagePartial(nn.Module):
    """A cross-stage partial (CSP) stage: one half of the channels passes the bottlenecks, the other half skips them."""

    def __init__(self, into: int, out: int, depth: int, shortcut: bool = True) -> None:
        super().__init__()
        half = out // 2
        self.through = nn.Sequential(unit(into, half), *(Bottleneck(half, shortcut) for _ in range(depth)))
        self.past = unit(into, half)
        self.merge = unit(2 * half, out)

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, out, H, W) from (B, into, H, W)."""
        return self.merge(torch.cat((self.through(maps), self.past(maps)), 1))


class SpatialPyramidPooling(nn.Module):
    """Spatial pyramid pooling: the input with its maxima over 5, 9 and 13 pixels, by repeated max pooling over 5."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = unit(channels, channels // 2)
        self.largest = nn.MaxPool2d(5, 1, 2)
        self.merge = unit(2 * channels, channels)

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape."""
        parts = [self.reduce(maps)]
        for _ in range(3):
            parts.append(self.largest(parts[-1]))
        return self.merge(torch.cat(parts, 1))


class SignDetector(nn.Module):
    """The detector: raw predictions for every anchor of every cell at three strides."""

    def __init__(self, config: SignsConfig) -> None:
        super().__init__()
        self.config = config
        c1, c2, c3, c4, c5 = (_multiple_of_8(channels * config.width) for channels in CHANNELS)
        d2, d3, d4, d5, neck = (max(1, round(depth * config.depth)) for depth in (*DEPTHS, NECK_DEPTH))
        self.to_8 = nn.Sequential(
            unit(3, c1, 6, 2, 2),
            unit(c1, c2, 3, 2),
            CrossStagePartial(c2, c2, d2),
            unit(c2, c3, 3, 2),
            CrossStagePartial(c3, c3, d3),
        )
        self.to_16 = nn.Sequential(unit(c3, c4, 3, 2), CrossStagePartial(c4, c4, d4))
        self.to_32 = nn.Sequential(unit(c4, c5, 3, 2), CrossStagePartial(c5, c5, d5), SpatialPyramidPooling(c5))
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.narrow_32, self.narrow_16 = unit(c5, c4), unit(c4, c3)
        self.down_16, self.down_8 = (
            CrossStagePartial(2 * c4, c4, neck, False),
            CrossStagePartial(2 * c3, c3, neck, False),
        )
        self.stride_8, self.stride_16 = unit(c3, c3, 3, 2), unit(c4, c4, 3, 2)
        self.up_16, self.up_32 = CrossStagePartial(2 * c3, c4, neck, False), CrossStagePartial(2 * c4, c5, neck, False)
        self.fields = 5 + len(config.classes)  # x, y, width, height, objectness, classes
        per_cell = len(config.anchors_px[0]) * self.fields
        self.heads = nn.ModuleList(nn.Conv2d(channels, per_cell, 1) for channels in (c3, c4, c5))
        self._start_with_few_objects()

    def forward(self, pictures: Tensor) -> list[Tensor]:
        """Return raw predictions (B, anchors, H / stride, W / stride, fields) at each of `STRIDES`.

        `pictures` (B, 3, H, W) are RGB in [0, 1]; H and W are multiples of 32. The fields are x, y, width, height,
        objectness, and one per class, all before the sigmoid.
        """
        at_8 = self.to_8(pictures)
        at_16 = self.to_16(at_8)
        narrow_32 = self.narrow_32(self.to_32(at_16))
        narrow_16 = self.narrow_16(self.down_16(torch.cat((self.up(narrow_32), at_16), 1)))
        fine = self.down_8(torch.cat((self.up(narrow_16), at_8), 1))
        middle = self.up_16(torch.cat((self.stride_8(fine), narrow_16), 1))
        coarse = self.up_32(torch.cat((self.stride_16(middle), narrow_32), 1))
        raw = [head(maps) for head, maps in zip(self.heads, (fine, middle, coarse), strict=True)]
        return [maps.unflatten(1, (-1, self.fields)).permute(0, 1, 3, 4, 2) for maps in raw]

    @torch.no_grad()
    def _start_with_few_objects(self) -> None:
        for head in self.heads:
            bias = head.bias.view(-1, self.fields)  # pyright: ignore[reportCallIssue]
            bias[:, 4] = math.log(EXPECTED_OBJECTS)
            bias[:, 5:] = math.log(1 / max(len(self.config.classes) - 1, 1))


def decode_level(raw: Tensor, level: int, config: SignsConfig) -> Tensor:
    """Return the boxes (B, anchors, rows, columns, 4) x1 y1 x2 y2 [px] of a level's raw predictions.

    A centre lies in its cell or up to half a cell outside; a width or height is at most four times the anchor's.
    """
    stride, (rows, columns) = STRIDES[level], raw.shape[2:4]
    across = torch.arange(columns, device=raw.device)
    down = torch.arange(rows, device=raw.device)
    cell = torch.stack((across.expand(rows, -1), down[:, None].expand(-1, columns)), -1)  # (rows, columns, 2)
    return decode_boxes(raw[..., :4], cell, raw.new_tensor(config.anchors_px[level])[:, None, None], stride)


def decode_boxes(raw: Tensor, cell: Tensor, anchor: Tensor, stride: int) -> Tensor:
    """Return boxes (..., 4) x1 y1 x2 y2 [px] of raw predictions t (..., 4), cells (..., 2) and anchors (..., 2) [px].

    With s = sigmoid(t) and the cell's column and row c: centre = (2 s_xy - 0.5 + c) stride, size = (2 s_wh)^2 anchor.
    """
    share = raw.sigmoid()
    center = (2 * share[..., :2] - 0.5 + cell) * stride
    half = (2 * share[..., 2:]).square() * anchor / 2
    return torch.cat((center - half, center + half), -1)


def _multiple_of_8(channels: float) -> int:
    return math.ceil(channels / 8) * 8
