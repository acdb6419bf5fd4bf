"""What a network of trajectories sees of the surroundings, and convolutions that see it on rasters."""

from typing import NamedTuple

from torch import Tensor, nn

from flcav.perception.trajectory.config import TrajectoryConfig
from flcav.perception.trajectory.rasters import LAYERS

COARSE = 8  # cells along each side of the map that is summed up


class Inputs(NamedTuple):
    """A batch as the network takes it."""

    past: Tensor  # (B, PAST + 1, 4) x, y, yaw, speed
    raster: Tensor | None = None  # (B, LAYERS, cells, cells) of zeros and ones
    pictures: Tensor | None = None  # (B, n, 3, height, width) in [-1, 1]
    intrinsics: Tensor | None = None  # (B, n, 3, 3)
    camera_from_frame: Tensor | None = None  # (B, n, 4, 4)


class Seen(NamedTuple):
    """The surroundings as features."""

    summary: Tensor  # (B, summary) of all of them
    ground: Tensor  # (B, maps[1], h, w) of each place in the patch, row 0 ahead and column 0 on the left
    map_logits: Tensor | None = None  # of the map, where it had to be learned


class Summary(nn.Module):
    """From maps of the patch to one vector that still knows what is where."""

    def __init__(self, maps: int, out: int, size: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv(maps, out, 2), nn.AdaptiveMaxPool2d(COARSE), nn.Flatten(), nn.Linear(out * COARSE**2, size), nn.ReLU()
        )

    def forward(self, ground: Tensor) -> Tensor:
        """Return (B, size) of (B, maps, h, w)."""
        return self.layers(ground)


class RasterEncoder(nn.Module):
    """Convolutions over rasters of the map and the tracks."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        fine, ground, coarse = config.maps
        self.summary = 2 * config.hidden
        self.layers = nn.Sequential(conv(len(LAYERS), fine, 2), conv(fine, ground, 2))
        self.sum_up = Summary(ground, coarse, self.summary)

    def forward(self, inputs: Inputs) -> Seen:
        """Return what is seen on (B, LAYERS, cells, cells) rasters; places are 4 x 4 cells."""
        assert inputs.raster is not None
        ground = self.layers(inputs.raster)
        return Seen(self.sum_up(ground), ground)


def conv(maps: int, out: int, stride: int | tuple[int, int] = 1) -> nn.Sequential:
    """Return a 3 x 3 convolution with its normalisation over groups of maps, and a rectifier."""
    return nn.Sequential(nn.Conv2d(maps, out, 3, stride, 1, bias=False), nn.GroupNorm(out // 8, out), nn.ReLU())
