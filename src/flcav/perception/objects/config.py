"""Configuration of a SECOND network and its data augmentation, stored beside the weights; and the anchors by class."""

import math
from typing import Annotated

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

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
    paste: Annotated[int, Field(ge=0)] = 0  # ground-truth sampling: objects per class up to which a sample is filled
    view: Annotated[float, Field(ge=0, le=1)] = 0.0  # probability of a cut to the field of view of a forward camera


@dataclass(frozen=True, config=STRICT, kw_only=True)
class SecondConfig:
    """Configuration of a SECOND network, in the LiDAR frame: x forward, y left, z up, metres, origin at the sensor.

    With `pillar_channels` the backbone takes pillars through 2D convolutions, not voxels through sparse 3D ones.
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
    around: bool = False  # whether it is asked to look to all four sides, by quarter turns of the sweep
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
