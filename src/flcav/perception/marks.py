"""What a network found in one input, as marks on it: few kinds, the same for every task. `flcav.report` draws each.

What is marked is a picture (H, W, 3), a point cloud (N, 4) or a map from above, see `flcav.perception.task.Finding`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bars:
    """A share for each of several names, drawn beside what was seen."""

    share: Mapping[str, float]  # name -> in [0, 1]
    title: str = "probability"

    @property
    def caption(self) -> str:
        """Return the name with the largest share."""
        return max(self.share, key=self.share.__getitem__)


@dataclass(frozen=True)
class PictureBoxes:
    """Upright rectangles on a picture."""

    box: Array  # (N, 4) x1 y1 x2 y2 [px] from the upper left corner of the picture
    label: NDArray[np.str_]  # (N,) class names
    score: Array  # (N,) in [0, 1]

    @property
    def caption(self) -> str:
        """Return how many there are."""
        return f"{len(self.box)} found"


@dataclass(frozen=True)
class CloudBoxes:
    """Boxes in a point cloud, and on the picture of a camera beside it."""

    boxes: Boxes  # in the frame of the cloud, with scores

    @property
    def caption(self) -> str:
        """Return how many there are."""
        return f"{len(self.boxes)} found"


@dataclass(frozen=True)
class Mode:
    """One of the futures that are thought possible."""

    probability: float
    path: Array  # (T, 2) world [m]


@dataclass(frozen=True)
class RoadUser:
    """Whose future is predicted."""

    track: str
    label: str  # class
    x: float  # world [m]
    y: float
    yaw: float  # [rad]
    speed: float  # [m/s]
    length: float  # [m]
    width: float
    modes: tuple[Mode, ...]  # the first is the one for who wants a single one, the others come by probability
    constant_velocity: Array | None = None  # (T, 2) world [m]: where it would be without turning or braking
    truth: Array | None = None  # (T, 2) world [m]: where it went, as far as that was recorded


@dataclass(frozen=True)
class Light:
    """The signal of a lane."""

    x: float  # world [m]
    y: float
    open: bool  # green


@dataclass(frozen=True)
class Paths:
    """Predicted paths on a map from above, around who observes."""

    observer: tuple[float, float, float]  # x, y, yaw in the world [m, rad]
    reach_m: float  # the map's, ahead of the observer, behind it and to both sides
    times_s: tuple[float, ...]  # (T,) of the points of every path, from the present
    users: tuple[RoadUser, ...]
    lights: tuple[Light, ...] = ()

    @property
    def caption(self) -> str:
        """Return for how many there are paths."""
        return f"{len(self.users)} predicted"


Mark = Bars | PictureBoxes | CloudBoxes | Paths
