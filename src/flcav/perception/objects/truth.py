"""Ground truth of object detection: targets, faint, hidden and lookalike objects of a frame.

An object of a class the network knows, with its centre in the network's range, is a *target* with five LiDAR returns or
more, *faint* with one to four, *hidden* with none. Training, evaluation, error registry and tracking share this
definition; how each treats the kinds is in docs/tasks.md.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.geometry import Boxes, inverse
from flcav.perception.objects.config import SecondConfig
from flcav.sensors.frame import Frame

DETECTION_CLASS = {
    "car": "Car",
    "van": "Car",
    "pedestrian": "Pedestrian",
    "bicycle": "Cyclist",
    "motorcycle": "Cyclist",
}
LOOKALIKE = {"truck": "Car", "bus": "Car"}  # neutral: a detection on one is neither true nor false
MIN_RETURNS = 5  # LiDAR returns that make an object a target

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of one frame: its M annotated actors, for a network of some classes and range.

    Rows are those of the frame's annotations. Besides targets, faint and hidden objects there are objects out of range,
    lookalikes, and actors of no class the network knows.
    """

    boxes: Boxes  # (M,) LiDAR frame; label = detection class, of a lookalike the one it resembles, else ""
    returns: NDArray[np.int64]  # (M,) of all LiDARs
    inside: Mask  # (M,) centre within the range in bird's-eye view
    lookalike: Mask  # (M,) trucks and buses, for a network that knows cars

    @cached_property
    def known(self) -> Mask:
        """Return (M,) whether the object is of a class of the network, in range or not."""
        return (self.boxes.label != "") & ~self.lookalike

    @cached_property
    def enough(self) -> Mask:
        """Return (M,) whether the object is of a known class with enough returns for a target, in range or not."""
        return self.known & (self.returns >= MIN_RETURNS)

    @cached_property
    def target(self) -> Mask:
        """Return (M,) whether the object is a target: of a known class, in range, with enough returns."""
        return self.enough & self.inside

    @cached_property
    def faint(self) -> Mask:
        """Return (M,) whether the object is faint: of a known class, in range, with some returns but too few."""
        return self.known & self.inside & (self.returns > 0) & ~self.enough

    @cached_property
    def hidden(self) -> Mask:
        """Return (M,) whether the object is hidden: of a known class, in range, without a return."""
        return self.known & self.inside & (self.returns == 0)


def ground_truth(frame: Frame, config: SecondConfig, lidar: str | None = None) -> GroundTruth:
    """Return the ground truth of `frame` for a network of `config`, in the frame of the LiDAR.

    lidar: its name; None: the frame's first. Raises `InputError` where the frame has none of that name.
    """
    annotations = frame.annotations
    boxes = annotations.boxes.transform(inverse(frame.world_from_sensor(choose_lidar(frame, lidar))))
    lookalike = is_lookalike(annotations.boxes.label, config.classes)
    label = np.where(lookalike, "Car", detection_labels(annotations.boxes.label, config.classes))
    named = Boxes(boxes.center, boxes.size, boxes.yaw, label)
    return GroundTruth(named, annotations.returns, in_range(boxes, config), lookalike)


def in_range(boxes: Boxes, config: SecondConfig) -> Mask:
    """Return (N,) whether the centre of each box (LiDAR frame) lies in the range of `config` in bird's-eye view."""
    x, y = boxes.center[:, 0], boxes.center[:, 1]
    x0, y0, _, x1, y1, _ = config.range_m
    return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def detection_labels(category: NDArray[np.str_], classes: tuple[str, ...]) -> NDArray[np.str_]:
    """Return the detection class (N,) of each actor category (N,), "" where it is none of `classes`."""
    mapped = [DETECTION_CLASS.get(str(name), "") for name in category]
    return np.array([name if name in classes else "" for name in mapped], dtype=np.str_)


def is_lookalike(category: NDArray[np.str_], classes: tuple[str, ...]) -> Mask:
    """Return (N,) whether an actor category (N,) resembles one of `classes` so that a detection is no error.

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
