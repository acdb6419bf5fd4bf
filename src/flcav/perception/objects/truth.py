"""Ground truth of object detection: targets, faint, hidden and lookalike objects of a frame, and target criteria.

An object of a class the network knows, with its centre in the network's range, is a *target* with five LiDAR returns or
more, *faint* with one to four, *hidden* with none. For a network that reads a radar, an echo counts as a return.
Training, evaluation, error registry and tracking share this definition; how each treats the kinds is in docs/tasks.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from flcav.arrays import Array, Ints, Mask, Words
from flcav.config import InputError
from flcav.geometry import Boxes, heading_vectors, inverse
from flcav.perception.agents import POLE, kind_of
from flcav.perception.objects.config import SecondConfig
from flcav.sensors.frame import Frame
from flcav.statistics.estimates import CONFIDENCE
from flcav.storage.records import LEFT_OUT
from flcav.world.weather import classify_weather

DETECTION_CLASS = {
    "car": "Car",
    "van": "Car",
    "pedestrian": "Pedestrian",
    "bicycle": "Cyclist",
    "motorcycle": "Cyclist",
}
CARS = tuple(kind for kind, name in DETECTION_CLASS.items() if name == "Car")  # categories of actors
LOOKALIKE = {"truck": "Car", "bus": "Car"}  # neutral: a detection on one is neither true nor false
MIN_RETURNS = 5  # LiDAR returns that make an object a target
QUARTERS = 4  # quarter turns in a full turn
LEVEL_M = 0.15  # difference of a mount's height from that of the training that needs no correction
LEVEL_RAD = 0.05  # the same for its direction


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a frame: its M annotated actors, for a network of some classes and range.

    Rows are those of the frame's annotations. In addition to targets, faint and hidden objects there are objects out of
    range, lookalikes, and actors of no class that the network knows.
    """

    boxes: Boxes  # (M,) LiDAR frame, with speeds; label = class, for a lookalike the one that it resembles, else ""
    returns: Ints  # (M,) by all LiDARs, and for a network that reads a radar also by all radars
    inside: Mask  # (M,) centre within the range in bird's-eye view
    lookalike: Mask  # (M,) trucks and buses, for a network that knows cars

    @cached_property
    def known(self) -> Mask:
        """Return the mask (M,) of objects of a class that the network knows, in range or not."""
        return (self.boxes.label != "") & ~self.lookalike

    @cached_property
    def enough(self) -> Mask:
        """Return the mask (M,) of objects of a known class with enough returns for a target, in range or not."""
        return self.known & (self.returns >= MIN_RETURNS)

    @cached_property
    def target(self) -> Mask:
        """Return the mask (M,) of targets: objects of a known class, in range, with enough returns."""
        return self.enough & self.inside

    @cached_property
    def faint(self) -> Mask:
        """Return the mask (M,) of faint objects: of a known class, in range, with some returns but too few."""
        return self.known & self.inside & (self.returns > 0) & ~self.enough

    @cached_property
    def hidden(self) -> Mask:
        """Return the mask (M,) of hidden objects: of a known class, in range, without a return."""
        return self.known & self.inside & (self.returns == 0)


def ground_truth(frame: Frame, config: SecondConfig, lidar: str | None = None) -> GroundTruth:
    """Return the ground truth of `frame` for a network of `config`, in the frame of the LiDAR.

    `lidar` is its name; None: the frame's first. Raises `InputError` where the frame has none of that name.
    """
    annotations = frame.annotations
    boxes = annotations.boxes.transform(inverse(frame.world_from_sensor(choose_lidar(frame, lidar))))
    lookalike = is_lookalike(annotations.boxes.label, config.classes)
    label = np.where(lookalike, "Car", detection_labels(annotations.boxes.label, config.classes))
    speed = (annotations.velocity[:, :2] * heading_vectors(annotations.boxes.yaw)).sum(1)
    named = Boxes(boxes.center, boxes.size, boxes.yaw, label, speed=speed)
    returns = annotations.returns
    if config.beside == "radar":
        returns = returns + sum(annotations.points[name] for name in frame.radar)
    return GroundTruth(named, returns, in_range(boxes, config), lookalike)


def in_range(boxes: Boxes, config: SecondConfig) -> Mask:
    """Return the mask (N,) of boxes (LiDAR frame) with their centre in the range of `config` in bird's-eye view.

    With `config.around` the range extends ahead, to the left, behind, and to the right.
    """
    x, y = boxes.center[:, 0], boxes.center[:, 1]
    x0, y0, _, x1, y1, _ = config.range_m
    inside = np.zeros(len(boxes), bool)
    for _ in range(QUARTERS if config.around else 1):
        inside |= (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
        x, y = y, -x
    return inside


def network_from_lidar(frame: Frame, config: SecondConfig, lidar: str | None = None) -> Array | None:
    """Return the transform (4, 4) [m] from a LiDAR's frame to that in which a network of `config` was trained.

    The latter is level, its x axis points ahead of the vehicle, and the ground is at `config.ground_z_m`. The mount is
    the one that the agent assumes. None where the mount is within `LEVEL_M` and `LEVEL_RAD` of that, and for poles,
    whose height above the ground is unknown. `lidar` is its name; None: the frame's first.
    """
    mount = frame.assumed.agent_from_sensor[choose_lidar(frame, lidar)]
    return None if kind_of(frame.agent) == POLE else level_mount(mount, config)


def level_mount(mount: Array, config: SecondConfig) -> Array | None:
    """Return the transform (4, 4) [m] of `network_from_lidar` for a vehicle's LiDAR of this `mount` (4, 4), or None."""
    levelled = np.eye(4)
    levelled[:3, :3], levelled[2, 3] = mount[:3, :3], mount[2, 3] + config.ground_z_m
    return None if turn_of(mount) <= LEVEL_RAD and abs(levelled[2, 3]) <= LEVEL_M else levelled


def turn_of(mount: Array) -> float:
    """Return the rotation angle [rad], in [0, pi], of a rigid transform (4, 4)."""
    return math.acos(min(1.0, max(-1.0, (float(np.trace(mount[:3, :3])) - 1) / 2)))


def detection_labels(category: Words, classes: tuple[str, ...]) -> Words:
    """Return the detection classes (N,) of actor categories (N,), "" where a class is not in `classes`."""
    mapped = [DETECTION_CLASS.get(str(name), "") for name in category]
    return np.array([name if name in classes else "" for name in mapped], dtype=np.str_)


def is_lookalike(category: Words, classes: tuple[str, ...]) -> Mask:
    """Return the mask (N,) of actor categories (N,) that resemble one of `classes`, so that a detection is no error.

    Trucks and buses resemble cars.
    """
    return np.array([LOOKALIKE.get(str(name)) in classes for name in category], dtype=bool)


def choose_lidar(frame: Frame, name: str | None = None) -> str:
    """Return the LiDAR `name` of the frame, None: its first; raises `InputError` where it has no such LiDAR."""
    if name is None and frame.lidar:
        return next(iter(frame.lidar))
    if name is None or name not in frame.lidar:
        wanted = "no LiDAR in it" if name is None else f"no LiDAR '{name}' in it; it has {sorted(frame.lidar)}"
        raise InputError(f"frame {frame.key}: {wanted}")
    return name


@dataclass(frozen=True)
class FrameTruth:
    """Ground truth of a frame for evaluation: targets, neutral and hidden objects, LiDAR frame, detection classes."""

    scene: str
    targets: Boxes  # (T,) objects to be found
    neutral: Boxes  # a detection on them is neither true nor false; label = the class they are neutral for
    hidden: Boxes  # in range without a return: counted, and neutral too
    occlusion: Array | None = None  # (T,) occluded share in [0, 1]; None: unknown
    weather: str | None = None  # weather class of the frame; None between the classes, or if unknown
    returns: Ints | None = None  # (T,) LiDAR returns; None: unknown


def asked_of(frame: Frame, config: SecondConfig) -> FrameTruth:
    """Return the targets, neutral and hidden objects of `frame` for the evaluation of a network of `config`.

    Faint and hidden objects, objects out of range and lookalikes are neutral. Raises `InputError` where the frame has
    no LiDAR.
    """
    truth = ground_truth(frame, config)
    neutral = (truth.known & ~truth.target) | truth.lookalike
    weather = None if frame.weather is None else classify_weather(frame.weather)
    hidden = frame.annotations.occlusion[truth.target].astype(float)
    occlusion = None if np.isnan(hidden).any() else hidden
    boxes = truth.boxes
    returns = truth.returns[truth.target]
    sides = boxes[truth.target], boxes[neutral], boxes[truth.hidden]
    return FrameTruth(frame.scene, *sides, occlusion, weather, returns)


def select_class(boxes: Boxes, name: str) -> Boxes:
    """Return the boxes with the label `name`."""
    return boxes[boxes.label == name]


def select_sides(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], name: str
) -> tuple[list[Boxes], list[Boxes], list[Boxes]]:
    """Return the detections, the targets and the neutral objects of the class `name` in each frame."""
    sides = (detections, [truth.targets for truth in truths], [truth.neutral for truth in truths])
    found, targets, neutral = ([select_class(boxes, name) for boxes in side] for side in sides)
    return found, targets, neutral


def narrow_range(config: SecondConfig, text: str) -> SecondConfig:
    """Return `config` with the smaller range `text`: metres ahead, a comma, metres to either side, as in "48,24".

    Networks of different ranges are evaluated on the same objects in this way. Raises `InputError` for any other text,
    and where the range exceeds that of the network.
    """
    try:
        ahead, side = map(float, text.split(","))
    except ValueError:
        ahead = side = math.nan
    if not (0 < ahead < math.inf and 0 < side < math.inf):
        raise InputError(f"range '{text}': metres ahead and metres to either side are wanted, as in 48,24")
    x0, y0, z0, x1, y1, z1 = config.range_m
    if x0 > 0 or x1 < ahead or y0 > -side or y1 < side:
        raise InputError(f"range '{text}': the network sees no further than {_extent(config.range_m)}")
    return replace(config, range_m=(0.0, -side, z0, ahead, side, z1))


def share_range(configs: Sequence[SecondConfig]) -> SecondConfig:
    """Return the first of `configs` with the classes and the range in bird's-eye view that all of them have.

    Raises `InputError` where they have no class or no place in common.
    """
    first, bounds = configs[0], np.array([config.range_m for config in configs])
    (x0, y0), (x1, y1) = bounds[:, :2].max(axis=0).tolist(), bounds[:, 3:5].min(axis=0).tolist()
    anchors = [each for each in first.anchors if all(each.name in config.classes for config in configs)]
    if not anchors or x1 <= x0 or y1 <= y0:
        raise InputError(f"the networks look for nothing in common: {'; '.join(map(describe_range, configs))}")
    low_z, high_z = first.range_m[2], first.range_m[5]
    around = all(config.around for config in configs)
    shared = (x0, y0, low_z, x1, y1, high_z)
    return replace(first, anchors=tuple(anchors), range_m=shared, around=around, calibration=None)


def describe_range(config: SecondConfig) -> str:
    """Return the classes and the range of a network of `config` in words."""
    return f"{', '.join(sorted(config.classes))}, {_extent(config.range_m, around=config.around)}"


@dataclass(frozen=True)
class TargetCriteria:
    """Criteria that make an object a target, and the confidence level of intervals."""

    range_m: tuple[float, ...]  # range of its centre, LiDAR frame: minima x, y, z, then maxima [m]
    min_returns: int  # LiDAR returns from it
    confidence: float  # in (0, 1)
    around: Annotated[bool | None, LEFT_OUT] = None  # whether the range also extends to the sides and behind
    echoes: Annotated[bool | None, LEFT_OUT] = None  # whether a radar's echoes count as returns

    def lines(self) -> list[str]:
        """Return the criteria in words: a line on targets, a line on intervals."""
        return [
            f"targets: centre {_extent(self.range_m, around=bool(self.around))}, "
            f"{self.min_returns} LiDAR returns{' and radar echoes' if self.echoes else ''} or more; "
            "others are neutral, and so are trucks and buses beside cars",
            f"intervals: {100 * self.confidence:g} %, over scenes",
        ]


def target_criteria(config: SecondConfig) -> TargetCriteria:
    """Return the target criteria of an evaluation of a network of `config`."""
    return TargetCriteria(
        tuple(config.range_m), MIN_RETURNS, CONFIDENCE, config.around or None, config.beside == "radar" or None
    )


def _extent(range_m: tuple[float, ...], *, around: bool = False) -> str:
    x0, y0, _, x1, y1, _ = range_m
    sides = f"{y1:g} m to either side" if y0 == -y1 else f"{-y0:g} m to the right and {y1:g} m to the left"
    return f"{x0:g} to {x1:g} m ahead and {sides}{', or as far to another side' if around else ''}"
