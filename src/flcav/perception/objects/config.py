"""Configurations of SECOND networks: anchors, augmentation of training samples, grids and widths, and the named ones.

They are stored together with the weights.
"""

import math
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from flcav.config import InputError

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
CELLS = 4096  # most voxels along an axis of the grid
Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(gt=0, le=4096)]
Layers = Annotated[int, Field(ge=0, le=64)]
Span = tuple[Positive, Positive]  # minimum, maximum
Margin = Annotated[float, Field(ge=-0.5, le=0.5)]
Portion = Annotated[float, Field(ge=0, lt=1)]
PAINT_CLASSES = ("else", "vehicle", "person", "two-wheeler")  # of the camera's network that paints points
COLUMNS = {"radar": 2, "painted": len(PAINT_CLASSES)}  # that a second modality adds to those of a sweep
SWEEP_COLUMNS = 4  # x, y, z [m], intensity
ECHO = -1.0  # "intensity" that marks an echo of a radar among the points of a sweep


def _unset(value: object) -> bool:
    """Return whether a field has its default: files of networks without it stay as they are."""
    return not value


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
    blind: Annotated[Portion, Field(exclude_if=_unset)] = 0.0  # probability of a sample without its second modality


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
    beside: Annotated[Literal["radar", "painted"] | None, Field(exclude_if=_unset)] = None  # modality beside the LiDAR:
    # echoes with range rate and cross-section, or points with the class scores of the camera's network
    speed: Annotated[bool, Field(exclude_if=_unset)] = False  # whether it predicts the objects' speeds over ground
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
        if self.beside is not None and not self.pillar_channels:
            raise ValueError(f"beside = '{self.beside}' needs pillars: set pillar_channels")
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
    def columns(self) -> int:
        """Return the number of columns of a point: x, y, z [m], intensity, and those of the second modality."""
        return SWEEP_COLUMNS + (COLUMNS[self.beside] if self.beside else 0)

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


def _anchors(classes: tuple[str, ...]) -> tuple[Anchor, ...]:
    unknown = [name for name in classes if name not in ANCHORS]
    if unknown or not classes:
        raise InputError(f"classes = {classes!r}: choose one or more of {', '.join(ANCHORS)}")
    return tuple(ANCHORS[name] for name in classes)


def pillars_far_config(
    beside: Literal["radar", "painted"] | None = None, classes: tuple[str, ...] = ("Car",), ground_z_m: float = -1.8
) -> SecondConfig:
    """Return the configuration of pillars to 64 m ahead that predicts speeds, with a second modality or none.

    In training a fourth of the samples lack their second modality, so that the network also works without it. Raises
    `InputError` for unknown classes.
    """
    return replace(
        pillars_config(classes, ground_z_m),
        range_m=(0, -24, -3, 64, 24, 1),
        beside=beside,
        speed=True,
        augmentation=Augmentation(blind=0.25 if beside else 0.0),
    )


CONFIGURATIONS = {  # the default first
    "pillars": pillars_config(),
    "tiny": tiny_config(),
    "small": small_config(),
    "road": road_config(),
    "paper": paper_config(),
    "pillars_far": pillars_far_config(),
    "pillars_radar": pillars_far_config("radar"),
    "pillars_painted": pillars_far_config("painted"),
}
