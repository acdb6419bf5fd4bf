"""SECOND: sparse 3D convolutions, a bird's-eye 2D network, one anchor head.

Yan, Mao, Li, "SECOND: Sparsely Embedded Convolutional Detection", Sensors 18(10):3337, 2018. Widths of `second_paper`
are those of the configuration the community publishes for KITTI (8x sparse backbone, 5.3 M parameters).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from flcav.config import InputError
from flcav.perception.device import bfloat16
from flcav.perception.objects.config import ANCHORS, KITTI_CAR, Anchor, Augmentation, SecondConfig
from flcav.perception.ops.norm import NormReLU
from flcav.perception.ops.sparse import SparseTensor, StridedConv3d, SubmanifoldConv3d
from flcav.perception.ops.voxels import grid_shape, voxelize

HEADINGS = 2  # anchors per class and place: along x, along y


class HeadOutput(NamedTuple):
    """Raw predictions for A = H W * classes * headings anchors of B samples."""

    score: Tensor  # (B, A, classes) logits
    box: Tensor  # (B, A, 7) residuals, see `targets.encode`
    direction: Tensor  # (B, A, 2) logits: which half-turn
    log_variance: Tensor | None = None  # (B, A, 7) of the residuals, where the network predicts it


class SparseBlock(nn.Module):
    """Sparse convolution, batch normalisation, ReLU."""

    def __init__(self, convolution: SubmanifoldConv3d | StridedConv3d, channels: int) -> None:
        super().__init__()
        self.convolution = convolution
        self.norm = NormReLU(channels)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the block's output voxels."""
        x = self.convolution(x)
        return x.with_features(self.norm(x.features))


def sparse_backbone(channels: tuple[int, int, int, int], out_channels: int) -> nn.Sequential:
    """Return the 3D part: four scales of submanifold blocks, then one convolution that halves the height."""
    blocks = [SparseBlock(SubmanifoldConv3d(i, channels[0]), channels[0]) for i in (4, channels[0])]
    for wide, narrow, padding in zip(channels[1:], channels, ((1, 1, 1), (1, 1, 1), (0, 1, 1)), strict=False):
        blocks.append(SparseBlock(StridedConv3d(narrow, wide, (3, 3, 3), (2, 2, 2), padding), wide))
        blocks += [SparseBlock(SubmanifoldConv3d(wide, wide), wide) for _ in range(2)]
    last = StridedConv3d(channels[3], out_channels, (3, 1, 1), (2, 1, 1), (0, 0, 0))
    return nn.Sequential(*blocks, SparseBlock(last, out_channels))


def _convolved(size: int, kernel: int, stride: int, padding: int) -> int:
    return (size + 2 * padding - kernel) // stride + 1


def head_shape(config: SecondConfig) -> tuple[int, int]:
    """Return the rows (y) and columns (x) of the head's grid."""
    _, rows, columns = grid_shape(config.range_m, config.voxel_m)
    for _ in range(3):
        rows, columns = _convolved(rows, 3, 2, 1), _convolved(columns, 3, 2, 1)
    return rows, columns


class Pointwise(nn.Linear):
    """1x1 convolution of (B, C, H, W) maps, as the one matrix product it is."""

    def forward(self, input: Tensor) -> Tensor:
        """Return (B, C', H, W)."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def _scale(inputs: int, outputs: int, stride: int, layers: int) -> nn.Sequential:
    """Return one scale of the bird's-eye network: a 3x3 convolution with the stride, then `layers` more."""
    modules: list[nn.Module] = [nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), NormReLU(outputs)]
    for _ in range(layers):
        modules += [nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), NormReLU(outputs)]
    return nn.Sequential(*modules)


class BirdsEye(nn.Module):
    """Two scales of 2D convolutions, brought to the first one's grid and joined."""

    def __init__(self, inputs: int, config: SecondConfig) -> None:
        super().__init__()
        (near, far), (near_up, far_up) = config.bev_channels, config.bev_up_channels
        self.near = _scale(inputs, near, 1, config.bev_layers[0])
        self.far = _scale(near, far, 2, config.bev_layers[1])
        self.near_up = nn.Sequential(Pointwise(near, near_up, bias=False), NormReLU(near_up))
        self.far_up = nn.Sequential(nn.ConvTranspose2d(far, far_up, 2, 2, bias=False), NormReLU(far_up))

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, sum of bev_up_channels, H, W) from (B, C, H, W)."""
        near = self.near(x)
        far = self.far_up(self.far(near))
        rows, columns = near.shape[2:]
        return torch.cat((self.near_up(near), far[:, :, :rows, :columns]), 1)


class Second(nn.Module):
    """The network of a `SecondConfig`."""

    def __init__(self, config: SecondConfig) -> None:
        super().__init__()
        self.config = config
        self.shape = grid_shape(config.range_m, config.voxel_m)
        self.backbone = sparse_backbone(config.sparse_channels, config.sparse_out)
        layers = self.shape[0]
        for kernel, stride, padding in ((3, 2, 1), (3, 2, 1), (3, 2, 0), (3, 2, 0)):
            layers = _convolved(layers, kernel, stride, padding)
        self.birds_eye = BirdsEye(config.sparse_out * layers, config).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        classes = len(config.classes)
        self.anchors_per_cell = classes * HEADINGS
        self.per_anchor = (classes, 7, 2, 7) if config.uncertainty else (classes, 7, 2)
        self.head = Pointwise(sum(config.bev_up_channels), self.anchors_per_cell * sum(self.per_anchor))
        nn.init.normal_(self.head.weight, 0, 0.001)
        nn.init.zeros_(self.head.bias)
        with torch.no_grad():  # a foreground probability of .01 (Lin et al., "Focal Loss", sec. 3.3)
            self.head.bias[: self.anchors_per_cell * classes] = -math.log(99)

    def voxels(self, points: Tensor, sample: Tensor, samples: int) -> SparseTensor:
        """Return the input voxels of points (N, 4) [LiDAR frame] of samples (N,), coordinates scaled to [-1, 1]."""
        features, keys = voxelize(points, sample, self.config.range_m, self.config.voxel_m, self.shape)
        bounds = features.new_tensor(self.config.range_m).view(2, 3)
        center, half = bounds.mean(0), (bounds[1] - bounds[0]) / 2
        intensity = features[:, 3:] if self.config.intensity else torch.zeros_like(features[:, 3:])
        scaled = torch.cat(((features[:, :3] - center) / half, intensity), 1)
        return SparseTensor(scaled, keys, self.shape, samples)

    def forward(self, voxels: SparseTensor) -> HeadOutput:
        """Return the raw predictions for every anchor."""
        features = voxels.features
        with bfloat16(features.device, self.training and self.config.bfloat16):
            maps = self.head(self.birds_eye(self.backbone(voxels).birds_eye()))
        cells = maps.to(features.dtype).permute(0, 2, 3, 1).flatten(1, 2)  # (B, H W, channels)
        parts = cells.split([self.anchors_per_cell * width for width in self.per_anchor], 2)
        return HeadOutput(*(part.reshape(len(cells), -1, n) for part, n in zip(parts, self.per_anchor, strict=True)))


def second(config: SecondConfig) -> Second:
    """Return a fresh network of `config`; torch's global generator draws its weights."""
    return Second(config)


def tiny_config(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> SecondConfig:
    """Return what the demo trains on a CPU: 0.33 M parameters, 0-48 m ahead, 24 m to either side."""
    return SecondConfig(
        anchors=_anchors(classes),
        range_m=(0, -24, -3, 48, 24, 1),
        voxel_m=(0.1, 0.1, 0.1),
        sparse_channels=(16, 16, 32, 32),
        sparse_out=32,
        bev_layers=(2, 2),
        bev_channels=(32, 64),
        bev_up_channels=(48, 48),
        ground_z_m=ground_z_m,
    )


def second_tiny(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> Second:
    """Return a fresh network of `tiny_config`."""
    return second(tiny_config(classes, ground_z_m))


def small_config(
    classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.73
) -> SecondConfig:
    """Return what a CPU trains in minutes: 0-51.2 m ahead, 28.8 m to either side, voxels of 0.1 m.

    KITTI's benchmark asks for cars of 25 pixels and more, which ends at 43 m. The network sees no intensity, which
    every LiDAR reports in its own way, and its training varies what differs between a simulated street and a real one:
    the sensor's tilt and height, how near cars stand and how large they are, lost returns, the field of view. Cars on
    KITTI's streets are smaller than ours: its mean car is the published anchor, and half of the cars are resized.
    """
    return SecondConfig(
        anchors=tuple(KITTI_CAR if anchor.name == "Car" else anchor for anchor in _anchors(classes)),
        range_m=(0, -28.8, -3, 51.2, 28.8, 1),
        voxel_m=(0.1, 0.1, 0.1),
        sparse_channels=(16, 16, 32, 32),
        sparse_out=32,
        bev_layers=(3, 3),
        bev_channels=(48, 96),
        bev_up_channels=(64, 64),
        ground_z_m=ground_z_m,
        intensity=False,
        uncertainty=True,
        bfloat16=True,
        augmentation=Augmentation(
            turn_rad=math.pi / 4,
            scale=0.05,
            shift_m=1.5,
            resize=((0.7, 1.1), (0.8, 1.05), (0.9, 1.15)),
            resized=0.5,
            tilt_rad=0.02,
            lift_m=0.2,
            drop=0.3,
            paste=8,
            view=0.6,
        ),
    )


def second_small(classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.73) -> Second:
    """Return a fresh network of `small_config`."""
    return second(small_config(classes, ground_z_m))


def paper_config(classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.8) -> SecondConfig:
    """Return the published widths: 5.3 M parameters, 0-70.4 m ahead, 40 m to either side."""
    return SecondConfig(
        anchors=_anchors(classes),
        range_m=(0, -40, -3, 70.4, 40, 1),
        voxel_m=(0.05, 0.05, 0.1),
        sparse_channels=(16, 32, 64, 64),
        sparse_out=128,
        bev_layers=(5, 5),
        bev_channels=(128, 256),
        bev_up_channels=(256, 256),
        ground_z_m=ground_z_m,
        bfloat16=True,
    )


def second_paper(classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.8) -> Second:
    """Return a fresh network of `paper_config`."""
    return second(paper_config(classes, ground_z_m))


def _anchors(classes: tuple[str, ...]) -> tuple[Anchor, ...]:
    unknown = [name for name in classes if name not in ANCHORS]
    if unknown or not classes:
        raise InputError(f"classes = {classes!r}: choose one or more of {', '.join(ANCHORS)}")
    return tuple(ANCHORS[name] for name in classes)


CONFIGURATIONS = {"tiny": tiny_config(), "small": small_config(), "paper": paper_config()}
