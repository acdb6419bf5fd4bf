"""SECOND: a sparse 3D backbone, a 2D network in bird's-eye view, one anchor head.

Yan, Mao, Li, "SECOND: Sparsely Embedded Convolutional Detection", Sensors 18(10):3337, 2018. The widths of
`second_paper` are those of the public configuration for KITTI (8x sparse backbone, 5.3 M parameters). A dense backbone
of pillars (Lang et al., "PointPillars", CVPR 2019) may replace the sparse one. Pillars may have channels of a second
modality: means of range rate and cross-section of a radar's echoes, or of the class scores of painted points (Vora et
al., "PointPainting", CVPR 2020).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from flcav.perception.device import autocast_bfloat16
from flcav.perception.objects.config import (
    COLUMNS,
    ECHO,
    SWEEP_COLUMNS,
    SecondConfig,
    paper_config,
    tiny_config,
)
from flcav.perception.ops.grids import STATISTICS, grid_shape, pillar_means, pillar_statistics, voxelize
from flcav.perception.ops.norm import NormReLU
from flcav.perception.ops.sparse import SparseTensor, StridedConv3d, SubmanifoldConv3d

LOG_VARIANCES = -10.0, 4.0  # a predicted log variance is clamped to this interval
SPEED_M_S = 10.0  # unit of speeds and range rates within the network
DBSM = 20.0  # unit of cross-sections within the network
HEADINGS = 2  # anchors per class and cell: along x, along y


class HeadOutput(NamedTuple):
    """Raw predictions of the anchor head for the A = H * W * classes * headings anchors of B samples."""

    score: Tensor  # (B, A, classes) logits
    box: Tensor  # (B, A, 7) residuals, see `flcav.perception.objects.loss.encode_residuals`
    direction: Tensor  # (B, A, 2) logits of the direction classes
    log_variance: Tensor | None = None  # (B, A, 7) of the residuals; None where the network predicts none
    speed: Tensor | None = None  # (B, A, 1) over ground, along the heading [SPEED_M_S]; None where it predicts none


class SparseBlock(nn.Module):
    """Sparse convolution, batch normalisation and ReLU."""

    def __init__(self, convolution: SubmanifoldConv3d | StridedConv3d, channels: int) -> None:
        super().__init__()
        self.convolution = convolution
        self.norm = NormReLU(channels)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the output of the block, on the voxels of the convolution."""
        x = self.convolution(x)
        return x.with_features(self.norm(x.features))


def sparse_backbone(channels: tuple[int, int, int, int], out_channels: int) -> nn.Sequential:
    """Return the 3D backbone, 4 channels in: submanifold blocks at strides 1, 2, 4, 8, then a convolution along z.

    The last convolution has kernel 3 and stride 2 along z, and halves the height.
    """
    blocks = [SparseBlock(SubmanifoldConv3d(i, channels[0]), channels[0]) for i in (4, channels[0])]
    for wide, narrow, padding in zip(channels[1:], channels, ((1, 1, 1), (1, 1, 1), (0, 1, 1)), strict=False):
        blocks.append(SparseBlock(StridedConv3d(narrow, wide, (3, 3, 3), (2, 2, 2), padding), wide))
        blocks += [SparseBlock(SubmanifoldConv3d(wide, wide), wide) for _ in range(2)]
    last = StridedConv3d(channels[3], out_channels, (3, 1, 1), (2, 1, 1), (0, 0, 0))
    return nn.Sequential(*blocks, SparseBlock(last, out_channels))


def pillar_backbone(channels: tuple[int, ...], more: int = 0) -> nn.Sequential:
    """Return the 2D backbone of pillars: two 3x3 convolutions at each of strides 2, 4, ...; STATISTICS + more in."""
    inputs = (STATISTICS + more, *channels)
    return nn.Sequential(*(_scale(narrow, wide, 2, 1) for narrow, wide in zip(inputs, channels, strict=False)))


def _convolved(size: int, kernel: int, stride: int, padding: int) -> int:
    return (size + 2 * padding - kernel) // stride + 1


def head_shape(config: SecondConfig) -> tuple[int, int]:
    """Return the rows (y) and columns (x) of the head's grid, that of the backbone's last stride."""
    _, rows, columns = grid_shape(config.range_m, config.voxel_m)
    for _ in config.pillar_channels or config.sparse_channels[1:]:
        rows, columns = _convolved(rows, 3, 2, 1), _convolved(columns, 3, 2, 1)
    return rows, columns


class Pointwise(nn.Linear):
    """1x1 convolution of (B, C, H, W) maps, computed as one matrix product."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the convolved map (B, C', H, W)."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def _scale(inputs: int, outputs: int, stride: int, layers: int) -> nn.Sequential:
    """Return one scale of the bird's-eye network: a 3x3 convolution with the stride, then `layers` more."""
    modules: list[nn.Module] = [nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), NormReLU(outputs)]
    for _ in range(layers):
        modules += [nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), NormReLU(outputs)]
    return nn.Sequential(*modules)


class BirdsEye(nn.Module):
    """2D backbone in bird's-eye view: convolutions at strides 1 and 2, upsampled to the first grid and concatenated."""

    def __init__(self, inputs: int, config: SecondConfig) -> None:
        super().__init__()
        (near, far), (near_up, far_up) = config.bev_channels, config.bev_up_channels
        self.near = _scale(inputs, near, 1, config.bev_layers[0])
        self.far = _scale(near, far, 2, config.bev_layers[1])
        self.near_up = nn.Sequential(Pointwise(near, near_up, bias=False), NormReLU(near_up))
        self.far_up = nn.Sequential(nn.ConvTranspose2d(far, far_up, 2, 2, bias=False), NormReLU(far_up))

    def forward(self, x: Tensor) -> Tensor:
        """Return the feature map (B, sum of bev_up_channels, H, W) of a map (B, C, H, W)."""
        near = self.near(x)
        far = self.far_up(self.far(near))
        rows, columns = near.shape[2:]
        return torch.cat((self.near_up(near), far[:, :, :rows, :columns]), 1)


class Second(nn.Module):
    """The SECOND network of a configuration: voxels or pillars, their backbone, 2D backbone, anchor head."""

    def __init__(self, config: SecondConfig) -> None:
        super().__init__()
        self.config = config
        self.shape = grid_shape(config.range_m, config.voxel_m)
        if config.pillar_channels:
            more = 1 + COLUMNS[config.beside] if config.beside else 0
            self.backbone, maps = pillar_backbone(config.pillar_channels, more), config.pillar_channels[-1]
        else:
            self.backbone, maps = sparse_backbone(config.sparse_channels, config.sparse_out), self.shape[0]
            for kernel, stride, padding in ((3, 2, 1), (3, 2, 1), (3, 2, 0), (3, 2, 0)):
                maps = _convolved(maps, kernel, stride, padding)
            maps *= config.sparse_out
        self.birds_eye = BirdsEye(maps, config)
        classes = len(config.classes)
        self.anchors_per_cell = classes * HEADINGS
        outputs = {"score": classes, "box": 7, "direction": 2}
        outputs |= {"log_variance": 7} if config.uncertainty else {}
        self.per_anchor = outputs | ({"speed": 1} if config.speed else {})
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.head = Pointwise(sum(config.bev_up_channels), self.anchors_per_cell * sum(self.per_anchor.values()))
        nn.init.normal_(self.head.weight, 0, 0.001)
        nn.init.zeros_(self.head.bias)
        with torch.no_grad():  # initial foreground probability 0.01 (Lin et al., "Focal Loss", sec. 3.3)
            self.head.bias[: self.anchors_per_cell * classes] = -math.log(99)

    def voxels(self, points: Tensor, sample: Tensor, samples: int) -> SparseTensor | Tensor:
        """Return the input of a batch of `samples` point clouds: voxels, coordinates scaled to [-1, 1]; or pillars.

        `points` is (N, config.columns): x, y, z [m], intensity, LiDAR frame, then what the second modality adds, see
        `flcav.perception.objects.modalities`; `sample` (N,) is the number of each point's cloud.
        """
        if self.config.pillar_channels:
            echo = points[:, 3] == ECHO
            sweep = points[~echo, :SWEEP_COLUMNS]
            sweep = sweep if self.config.intensity else sweep * points.new_tensor((1, 1, 1, 0))
            grid = (self.config.range_m, self.config.voxel_m)
            maps = pillar_statistics(sweep, sample[~echo], samples, *grid, self.config.ground_z_m)
            if self.config.beside:
                shown = echo if self.config.beside == "radar" else (points[:, SWEEP_COLUMNS:] > 0).any(1)
                values = points[shown, SWEEP_COLUMNS:]
                values = values / values.new_tensor((SPEED_M_S, DBSM)) if self.config.beside == "radar" else values
                maps = torch.cat((maps, pillar_means(points[shown], values, sample[shown], samples, *grid)), 1)
            return maps.contiguous(memory_format=torch.channels_last)
        features, keys = voxelize(points, sample, self.config.range_m, self.config.voxel_m, self.shape)
        bounds = features.new_tensor(self.config.range_m).view(2, 3)
        center, half = bounds.mean(0), (bounds[1] - bounds[0]) / 2
        intensity = features[:, 3:] if self.config.intensity else torch.zeros_like(features[:, 3:])
        scaled = torch.cat(((features[:, :3] - center) / half, intensity), 1)
        return SparseTensor(scaled, keys, self.shape, samples)

    def forward(self, voxels: SparseTensor | Tensor) -> HeadOutput:
        """Return the raw predictions for every anchor of each sample."""
        return self.answer(self.map_features(voxels))

    def map_features(self, voxels: SparseTensor | Tensor) -> Tensor:
        """Return the bird's-eye feature map (B, C, H, W) that the head reads, rows along y, columns along x."""
        with autocast_bfloat16(self.head.weight.device, self.training and self.config.bfloat16):
            maps = self.backbone(voxels)
            return self.birds_eye(maps.birds_eye() if isinstance(maps, SparseTensor) else maps)

    def answer(self, features: Tensor) -> HeadOutput:
        """Return the raw predictions of the head from bird's-eye feature maps (B, C, H, W)."""
        with autocast_bfloat16(features.device, self.training and self.config.bfloat16):
            maps = self.head(features)
        cells = maps.to(self.head.weight.dtype).permute(0, 2, 3, 1).flatten(1, 2)  # (B, H W, channels)
        parts = cells.split([self.anchors_per_cell * width for width in self.per_anchor.values()], 2)
        outputs = zip(self.per_anchor.items(), parts, strict=True)
        return HeadOutput(**{name: part.reshape(len(cells), -1, width) for (name, width), part in outputs})


def second(config: SecondConfig) -> Second:
    """Return a new SECOND network of `config`, with weights drawn by torch's global generator."""
    return Second(config)


def second_tiny(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> Second:
    """Return a new network of `tiny_config`."""
    return second(tiny_config(classes, ground_z_m))


def second_paper(classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.8) -> Second:
    """Return a new network of `paper_config`."""
    return second(paper_config(classes, ground_z_m))
