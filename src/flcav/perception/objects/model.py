"""SECOND and its configurations: a sparse 3D backbone, a 2D network in bird's-eye view, one anchor head.

Yan, Mao, Li, "SECOND: Sparsely Embedded Convolutional Detection", Sensors 18(10):3337, 2018. The widths of
`second_paper` are those of the public configuration for KITTI (8x sparse backbone, 5.3 M parameters). A dense backbone
of pillars (Lang et al., "PointPillars", CVPR 2019) may replace the sparse one. Configurations include the augmentation
of training samples, and are stored together with the weights.
"""

import math
from dataclasses import replace
from typing import Annotated, NamedTuple

import torch
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from flcav.config import InputError
from flcav.perception.device import autocast_bfloat16
from flcav.perception.ops.grids import STATISTICS, grid_shape, pillar_statistics, voxelize
from flcav.perception.ops.norm import NormReLU
from flcav.perception.ops.sparse import SparseTensor, StridedConv3d, SubmanifoldConv3d

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
CELLS = 4096  # most voxels along an axis of the grid
Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(gt=0, le=4096)]
Layers = Annotated[int, Field(ge=0, le=64)]
Span = tuple[Positive, Positive]  # minimum, maximum
Margin = Annotated[float, Field(ge=-0.5, le=0.5)]
Portion = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, config=STRICT)
class Anchor:
    """Anchor box of a class, placed at every cell of the head's grid with headings along x and along y."""

    name: str  # detection class
    length_m: Positive
    width_m: Positive
    height_m: Positive
    matched_iou: Share  # bird's-eye IoU from which an anchor is positive
    unmatched_iou: Share  # bird's-eye IoU below which an anchor is negative


@dataclass(frozen=True, config=STRICT)
class Augmentation:
    """Data augmentation of training samples; amounts are drawn uniformly up to the limits given here."""

    flip: bool = False  # mirror left-right, with probability 1/2; traffic then keeps to the other side: headings suffer
    turn_rad: Annotated[float, Field(ge=0, lt=math.pi / 2)] = 0.3  # rotation about the sensor, to either side
    scale: Portion = 0.03  # factor of the whole scene in [1 - scale, 1 + scale]
    shift_m: Annotated[float, Field(ge=0)] = 0.0  # of the whole scene, along x and along y, to either side
    resize: tuple[Span, Span, Span] = ((1, 1), (1, 1), (1, 1))  # factors of a car's length, width and height
    resized: Annotated[float, Field(ge=0, le=1)] = 1.0  # probability that a car is resized
    margin_m: tuple[tuple[str, Margin, Margin, Margin], ...] = ()  # class; its boxes are longer, wider, higher by that
    tilt_rad: Portion = 0.0  # of the sensor, about any horizontal axis
    lift_m: Portion = 0.0  # of the sensor, up or down
    drop: Portion = 0.0  # share of the returns that are dropped
    fade: Portion = 0.0  # share of an object's returns that are dropped besides, by object
    thin: Annotated[float, Field(ge=0, le=1)] = 0.0  # probability that a dense sweep is thinned to few beams
    paste: Annotated[int, Field(ge=0)] = 0  # ground-truth sampling: objects per class up to which a sample is filled
    alike: Annotated[float, Field(ge=1)] | None = None  # their sweeps have up to so many times more or fewer returns
    view: Annotated[float, Field(ge=0, le=1)] = 0.0  # probability of a cut to the field of view of a forward camera


@dataclass(frozen=True, config=STRICT, kw_only=True)
class SecondConfig:
    """Configuration of a SECOND network, in the LiDAR frame: x forward, y left, z up, metres, origin at the sensor.

    With `pillar_channels` the backbone processes pillars by 2D convolutions instead of voxels by sparse 3D ones.
    """

    anchors: Annotated[tuple[Anchor, ...], Field(min_length=1)]  # one per class, in the order of the scores
    range_m: tuple[float, float, float, float, float, float]  # x, y, z minima, then maxima
    voxel_m: tuple[Positive, Positive, Positive]  # x, y, z; pillars have no z
    sparse_channels: tuple[Count, Count, Count, Count] = (16, 16, 32, 32)  # of the 3D backbone at strides 1, 2, 4, 8
    sparse_out: Count = 32  # channels after the last convolution along z
    pillar_channels: tuple[Count, ...] = ()  # of the 2D backbone of pillars at strides 2, 4, ...; (): voxels in 3D
    bev_layers: tuple[Layers, Layers]  # 3x3 convolutions after the first, at strides 1 and 2 of the head's grid
    bev_channels: tuple[Count, Count]  # of these two scales
    bev_up_channels: tuple[Count, Count]  # of these two scales, brought to the head's grid
    ground_z_m: float = -1.8  # height of the ground that anchors stand on: minus the sensor's height
    intensity: bool = True  # whether intensity is an input
    foreground: bool = False  # whether roadside sweeps come without their static background
    uncertainty: bool = False  # whether the network predicts a variance of each residual
    bfloat16: bool = False  # autocast in training where the hardware supports it: on a CPU in the 2D part alone
    around: bool = False  # whether it looks to all four sides, by quarter turns of the sweep
    calibration: tuple[tuple[float, float], ...] | None = None  # Platt scaling, per class: factor and summand of logits
    augmentation: Augmentation = Augmentation()  # of training samples

    @model_validator(mode="after")
    def _positive_extent(self) -> "SecondConfig":
        low, high = self.range_m[:3], self.range_m[3:]
        if any(b <= a for a, b in zip(low, high, strict=True)):
            raise ValueError("every axis of range_m needs a maximum above its minimum")
        if any((b - a) / size > CELLS for a, b, size in zip(low, high, self.voxel_m, strict=True)):
            raise ValueError(f"range_m has more than {CELLS} voxels along an axis")
        if self.calibration is not None and len(self.calibration) != len(self.anchors):
            raise ValueError(
                f"{len(self.anchors)} classes need as many pairs in calibration, not {len(self.calibration)}"
            )
        return self

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the detection classes, in the order of the scores."""
        return tuple(anchor.name for anchor in self.anchors)

    @property
    def reach_m(self) -> float:
        """Return the largest horizontal distance from the sensor to a corner of the range [m]."""
        x0, y0, _, x1, y1, _ = self.range_m
        return max(math.hypot(x, y) for x in (x0, x1) for y in (y0, y1))


ANCHORS = {
    "Car": Anchor(name="Car", length_m=4.4, width_m=1.8, height_m=1.6, matched_iou=0.6, unmatched_iou=0.45),
    "Pedestrian": Anchor(
        name="Pedestrian", length_m=0.8, width_m=0.6, height_m=1.73, matched_iou=0.5, unmatched_iou=0.35
    ),
    "Cyclist": Anchor(name="Cyclist", length_m=1.76, width_m=0.6, height_m=1.73, matched_iou=0.5, unmatched_iou=0.35),
}
KITTI_CAR = Anchor(name="Car", length_m=3.9, width_m=1.6, height_m=1.56, matched_iou=0.6, unmatched_iou=0.45)


LOG_VARIANCES = -10.0, 4.0  # a predicted log variance is clamped to this interval
HEADINGS = 2  # anchors per class and cell: along x, along y


class HeadOutput(NamedTuple):
    """Raw predictions of the anchor head for the A = H * W * classes * headings anchors of B samples."""

    score: Tensor  # (B, A, classes) logits
    box: Tensor  # (B, A, 7) residuals, see `flcav.perception.objects.loss.encode_residuals`
    direction: Tensor  # (B, A, 2) logits of the direction classes
    log_variance: Tensor | None = None  # (B, A, 7) of the residuals; None where the network predicts none


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


def pillar_backbone(channels: tuple[int, ...]) -> nn.Sequential:
    """Return the 2D backbone of pillars, STATISTICS channels in: two 3x3 convolutions at each of strides 2, 4, ..."""
    inputs = (STATISTICS, *channels)
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
            self.backbone, maps = pillar_backbone(config.pillar_channels), config.pillar_channels[-1]
        else:
            self.backbone, maps = sparse_backbone(config.sparse_channels, config.sparse_out), self.shape[0]
            for kernel, stride, padding in ((3, 2, 1), (3, 2, 1), (3, 2, 0), (3, 2, 0)):
                maps = _convolved(maps, kernel, stride, padding)
            maps *= config.sparse_out
        self.birds_eye = BirdsEye(maps, config)
        classes = len(config.classes)
        self.anchors_per_cell = classes * HEADINGS
        self.per_anchor = (classes, 7, 2, 7) if config.uncertainty else (classes, 7, 2)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.head = Pointwise(sum(config.bev_up_channels), self.anchors_per_cell * sum(self.per_anchor))
        nn.init.normal_(self.head.weight, 0, 0.001)
        nn.init.zeros_(self.head.bias)
        with torch.no_grad():  # initial foreground probability 0.01 (Lin et al., "Focal Loss", sec. 3.3)
            self.head.bias[: self.anchors_per_cell * classes] = -math.log(99)

    def voxels(self, points: Tensor, sample: Tensor, samples: int) -> SparseTensor | Tensor:
        """Return the input of a batch of `samples` point clouds: voxels, coordinates scaled to [-1, 1]; or pillars.

        `points` is (N, 4): x, y, z [m], intensity, LiDAR frame; `sample` (N,) is the number of each point's cloud.
        """
        if self.config.pillar_channels:
            points = points if self.config.intensity else points * points.new_tensor((1, 1, 1, 0))
            grid = (self.config.range_m, self.config.voxel_m, self.config.ground_z_m)
            maps = pillar_statistics(points, sample, samples, *grid)
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
        parts = cells.split([self.anchors_per_cell * width for width in self.per_anchor], 2)
        return HeadOutput(*(part.reshape(len(cells), -1, n) for part, n in zip(parts, self.per_anchor, strict=True)))


def second(config: SecondConfig) -> Second:
    """Return a new SECOND network of `config`, with weights drawn by torch's global generator."""
    return Second(config)


def tiny_config(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> SecondConfig:
    """Return the smallest SECOND's configuration, for a CPU: 0.33 M parameters, 0-48 m ahead, 24 m to either side.

    Raises `InputError` for unknown classes.
    """
    return SecondConfig(
        anchors=_anchors(classes),
        range_m=(0, -24, -3, 48, 24, 1),
        voxel_m=(0.1, 0.1, 0.1),
        bev_layers=(2, 2),
        bev_channels=(32, 64),
        bev_up_channels=(48, 48),
        ground_z_m=ground_z_m,
    )


def pillars_config(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> SecondConfig:
    """Return the demo's configuration, of pillars: the range of `tiny_config`, 0.16 M parameters, a third of the time.

    Raises `InputError` for unknown classes.
    """
    return replace(
        tiny_config(classes, ground_z_m),
        voxel_m=(0.25, 0.25, 4),
        pillar_channels=(24, 48),
        bev_layers=(1, 1),
        bev_channels=(48, 64),
    )


def second_tiny(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8) -> Second:
    """Return a new network of `tiny_config`."""
    return second(tiny_config(classes, ground_z_m))


def small_config(
    classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.73
) -> SecondConfig:
    """Return the configuration of the study, trained on a CPU: 0-51.2 m ahead, 28.8 m to either side, voxels of 0.1 m.

    KITTI's benchmark counts cars of 25 pixels or more, which are within 43 m. Intensity is not an input, since every
    LiDAR reports it in a different way. The augmentation varies what differs between simulated and real streets: tilt
    and height of the sensor, distance and size of cars, lost returns, field of view. KITTI's cars are smaller than the
    simulated ones, so that the anchor is the published one, KITTI's mean car, and most cars are resized. Boxes have the
    margins of KITTI's labels. Raises `InputError` for unknown classes.
    """
    return SecondConfig(
        anchors=tuple(KITTI_CAR if anchor.name == "Car" else anchor for anchor in _anchors(classes)),
        range_m=(0, -28.8, -3, 51.2, 28.8, 1),
        voxel_m=(0.1, 0.1, 0.1),
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
            resize=((0.7, 1.05), (0.8, 1.05), (0.9, 1.15)),
            resized=0.8,
            margin_m=(("Car", 0.12, -0.06, 0.0), ("Pedestrian", 0.08, 0.08, 0.0)),
            tilt_rad=0.02,
            lift_m=0.2,
            drop=0.3,
            paste=8,
            view=0.6,
        ),
    )


def road_config(classes: tuple[str, ...] = ("Car",), ground_z_m: float = -6.0) -> SecondConfig:
    """Return the configuration of the roadside detector: 38.4 m to every side of a LiDAR 6 m above the road.

    Its layers are those of `small_config`. A pole may stand anywhere at the roadside, so that samples are rotated by up
    to a quarter turn to either side. Raises `InputError` for unknown classes.
    """
    return replace(
        small_config(classes, ground_z_m),
        anchors=_anchors(classes),
        range_m=(-38.4, -38.4, ground_z_m - 0.7, 38.4, 38.4, ground_z_m + 3.3),
        foreground=True,
        augmentation=Augmentation(turn_rad=1.57, scale=0.03, lift_m=0.1, drop=0.2),
    )


def paper_config(classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"), ground_z_m: float = -1.8) -> SecondConfig:
    """Return the configuration with the published widths: 5.3 M parameters, 0-70.4 m ahead, 40 m to either side.

    Raises `InputError` for unknown classes.
    """
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
    """Return a new network of `paper_config`."""
    return second(paper_config(classes, ground_z_m))


def _anchors(classes: tuple[str, ...]) -> tuple[Anchor, ...]:
    unknown = [name for name in classes if name not in ANCHORS]
    if unknown or not classes:
        raise InputError(f"classes = {classes!r}: choose one or more of {', '.join(ANCHORS)}")
    return tuple(ANCHORS[name] for name in classes)


CONFIGURATIONS = {  # the default first
    "pillars": pillars_config(),
    "tiny": tiny_config(),
    "small": small_config(),
    "road": road_config(),
    "paper": paper_config(),
}
