"""A segmentation network for road markings and its configurations: an encoder of residual blocks, a decoder with skips.

The encoder ends at a stride of 16 pixels with dilated convolutions (Yu and Koltun, "Multi-Scale Context Aggregation by
Dilated Convolutions", ICLR 2016), so that a line is seen as a whole. The decoder adds the maps of strides 8 and 4, as a
feature pyramid does (Lin et al., "Feature Pyramid Networks for Object Detection", CVPR 2017).
"""

from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch.nn import functional

from flcav.dataset.road_labels import ROAD_CLASSES

STRIDE = 4  # [px] of the network's output
LARGEST_STRIDE = 16  # [px]: sides of its input are multiples
Channels = Annotated[int, Field(ge=4, le=512)]
Window = Annotated[int, Field(ge=32, le=8192, multiple_of=LARGEST_STRIDE)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class RoadConfig:
    """Configuration of a road network, which takes images of any size; lengths are in pixels of the image."""

    channels: tuple[Channels, Channels, Channels, Channels]  # of the maps at strides 2, 4, 8 and 16
    dilations: tuple[Annotated[int, Field(ge=1, le=32)], ...] = (1, 2, 4, 8)  # of the blocks at stride 16
    window_px: tuple[Window, Window] = (384, 192)  # width, height of a training sample


CONFIGURATIONS = {
    "small": RoadConfig((16, 32, 64, 96)),
    "tiny": RoadConfig((8, 16, 32, 48), window_px=(320, 192)),
}


def unit(into: int, out: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Return a convolution with batch normalisation and ReLU, which keeps the size at stride 1."""
    padding = dilation * (kernel // 2)
    convolution = nn.Conv2d(into, out, kernel, stride, padding, dilation, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.ReLU(inplace=True))


class Block(nn.Module):
    """A residual block: a dilated and a plain 3 x 3 convolution (He et al., CVPR 2016)."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        last = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.layers = nn.Sequential(unit(channels, channels, dilation=dilation), last, nn.BatchNorm2d(channels))

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape."""
        return torch.relu(maps + self.layers(maps))


class RoadNetwork(nn.Module):
    """The network: a logit for every class, by default of `ROAD_CLASSES`, in every cell of `STRIDE` pixels."""

    def __init__(self, config: RoadConfig, classes: int = len(ROAD_CLASSES)) -> None:
        super().__init__()
        self.config = config
        c2, c4, c8, c16 = config.channels
        self.to_4 = nn.Sequential(unit(3, c2, stride=2), unit(c2, c4, stride=2), Block(c4))
        self.to_8 = nn.Sequential(unit(c4, c8, stride=2), Block(c8), Block(c8))
        self.to_16 = nn.Sequential(unit(c8, c16, stride=2), *(Block(c16, dilation) for dilation in config.dilations))
        self.narrow_16, self.narrow_8 = unit(c16, c8, 1), unit(c8, c4, 1)
        self.mix_8, self.mix_4 = unit(c8, c8), unit(c4, c4)
        self.head = nn.Conv2d(c4, classes, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return logits (B, classes, H / 4, W / 4) of images (B, 3, H, W) in [-1, 1]; H and W are multiples of 16."""
        at_4 = self.to_4(pictures)
        at_8 = self.to_8(at_4)
        at_16 = self.to_16(at_8)
        fine = self.mix_8(at_8 + enlarge(self.narrow_16(at_16), 2))
        finer = self.mix_4(at_4 + enlarge(self.narrow_8(fine), 2))
        return self.head(finer)


def enlarge(maps: Tensor, factor: int) -> Tensor:
    """Return maps (B, C, H, W) enlarged bilinearly to (B, C, factor H, factor W)."""
    return functional.interpolate(maps, scale_factor=float(factor), mode="bilinear", align_corners=False)
