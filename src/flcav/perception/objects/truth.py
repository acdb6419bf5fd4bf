"""Which objects of a frame count for a detector: the one rule of training, evaluation, error registry and tracking.

An object of a class the network knows, its centre in the network's range, is a *target* with five LiDAR returns or
more, *faint* with one to four, *hidden* with none. What each user makes of them is in docs/tasks.md.
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
LOOKALIKE = {"truck": "Car", "bus": "Car"}  # neutral: neither to be found nor to be kept apart
MIN_RETURNS = 5  # LiDAR returns that make an object a target

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Truth:
    """The M annotated actors of a frame, as a network of some classes and range is asked for them.

    Rows are those of the frame's annotations. Beside targets, faint and hidden objects there are those out of range,
    `lookalike` ones, and actors of no class the network knows.
    """

    boxes: Boxes  # (M,) LiDAR frame; label = detection class, of a lookalike the one it looks like, else ""
    returns: NDArray[np.int64]  # (M,) of all LiDARs
    inside: Mask  # (M,) centre within the range, seen from above
    lookalike: Mask  # (M,) trucks and buses beside cars

    @cached_property
    def known(self) -> Mask:
        """Return which objects are of a class of the network, wherever they are."""
        return (self.boxes.label != "") & ~self.lookalike

    @cached_property
    def enough(self) -> Mask:
        """Return which known objects have returns enough to be targets, wherever they are."""
        return self.known & (self.returns >= MIN_RETURNS)

    @cached_property
    def target(self) -> Mask:
        """Return which objects are to be found."""
        return self.enough & self.inside

    @cached_property
    def faint(self) -> Mask:
        """Return which objects in range have some returns, but too few for a target."""
        return self.known & self.inside & (self.returns > 0) & ~self.enough

    @cached_property
    def hidden(self) -> Mask:
        """Return which objects in range have no return."""
        return self.known & self.inside & (self.returns == 0)


def ground_truth(frame: Frame, config: SecondConfig, lidar: str | None = None) -> Truth:
    """Return the actors of `frame` as a network of `config` is asked for them, in the frame of the LiDAR.

    `lidar`: None where the frame has one. Raises `InputError` where the frame has none of that name.
    """
    annotations = frame.annotations
    boxes = annotations.boxes.transformed(inverse(frame.world_from_sensor(only_lidar(frame, lidar))))
    lookalike = is_lookalike(annotations.boxes.label, config.classes)
    label = np.where(lookalike, "Car", detection_labels(annotations.boxes.label, config.classes))
    named = Boxes(boxes.center, boxes.size, boxes.yaw, label)
    return Truth(named, annotations.returns, in_range(boxes, config), lookalike)


def in_range(boxes: Boxes, config: SecondConfig) -> Mask:
    """Return (N,) whether a box's centre lies within the range, seen from above."""
    x, y = boxes.center[:, 0], boxes.center[:, 1]
    x0, y0, _, x1, y1, _ = config.range_m
    return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def detection_labels(category: NDArray[np.str_], classes: tuple[str, ...]) -> NDArray[np.str_]:
    """Return the detection class of every actor category, "" where the network knows none."""
    mapped = [DETECTION_CLASS.get(str(name), "") for name in category]
    return np.array([name if name in classes else "" for name in mapped], dtype=np.str_)


def is_lookalike(category: NDArray[np.str_], classes: tuple[str, ...]) -> Mask:
    """Return which actors look so much like one of `classes` that finding them is no mistake (trucks, buses)."""
    return np.array([LOOKALIKE.get(str(name)) in classes for name in category], dtype=bool)


def only_lidar(frame: Frame, name: str | None = None) -> str:
    """Return `name`, or the frame's first LiDAR; raises `InputError` where it has none."""
    if name is None and frame.lidar:
        return next(iter(frame.lidar))
    if name is None or name not in frame.lidar:
        wanted = "no LiDAR in it" if name is None else f"no LiDAR '{name}' in it; it has {sorted(frame.lidar)}"
        raise InputError(f"frame {frame.key}: {wanted}")
    return name
