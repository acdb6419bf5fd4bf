"""Marks: drawable results of an inference, of a few kinds shared by all tasks; `flcav.report` draws them.

They are drawn on an image (H, W, 3), a point cloud (N, 4) or a bird's-eye map, see `flcav.perception.task.Finding`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.arrays import Array, Bytes, Words
from flcav.geometry import Boxes


@dataclass(frozen=True)
class Bars:
    """A bar chart of shares by name, such as class probabilities, drawn next to the input."""

    share: Mapping[str, float]  # name -> in [0, 1]
    title: str = "probability"

    @property
    def caption(self) -> str:
        """Return the name with the largest share."""
        return max(self.share, key=self.share.__getitem__)


@dataclass(frozen=True)
class PictureBoxes:
    """Axis-aligned 2D boxes on an image."""

    box: Array  # (N, 4) x1 y1 x2 y2 [px] from the upper left corner of the image
    label: Words  # (N,) class names
    score: Array  # (N,) in [0, 1]

    @property
    def caption(self) -> str:
        """Return the number of boxes in words."""
        return f"{len(self.box)} found"


@dataclass(frozen=True)
class PictureClasses:
    """A class for every pixel of an image; the first class is the background, which is not drawn."""

    classes: Bytes  # (H, W) index in `names`
    names: tuple[str, ...]

    @property
    def caption(self) -> str:
        """Return the share of the image that is not background, in words."""
        return f"{(self.classes > 0).mean():.1%} of the picture marked"


@dataclass(frozen=True)
class PictureLines:
    """Polylines on an image."""

    lines: tuple[Array, ...]  # (K, 2) u, v [px]; the centre of the first pixel is (0, 0)
    kind: tuple[str, ...]  # of each line

    @property
    def caption(self) -> str:
        """Return the number of lines in words."""
        return f"{len(self.lines)} line{'s' * (len(self.lines) != 1)}"


@dataclass(frozen=True)
class GroundLines:
    """Polylines on the ground in front of an agent, drawn next to the input in bird's-eye view."""

    lines: tuple[Array, ...]  # (K, 2) x forward, y left of the agent [m]
    kind: tuple[str, ...]  # of each line

    @property
    def caption(self) -> str:
        """Return how far ahead the lines reach, in words."""
        return f"up to {max((float(line[:, 0].max()) for line in self.lines), default=0.0):.0f} m ahead"


@dataclass(frozen=True)
class CloudBoxes:
    """3D boxes in a point cloud, also drawn on the image of a camera with the same direction."""

    boxes: Boxes  # in the frame of the cloud, with scores

    @property
    def caption(self) -> str:
        """Return the number of boxes in words."""
        return f"{len(self.boxes)} found"


@dataclass(frozen=True)
class Mode:
    """One mode of a trajectory forecast."""

    probability: float
    path: Array  # (T, 2) world [m]


@dataclass(frozen=True)
class RoadUser:
    """A road user with its predicted modes, the constant-velocity baseline and the ground truth."""

    track: str
    label: str  # class
    x: float  # world [m]
    y: float
    yaw: float  # [rad]
    speed: float  # [m/s]
    length: float  # [m]
    width: float
    modes: tuple[Mode, ...]  # first the single path (the medoid), then the others by decreasing probability
    constant_velocity: Array | None = None  # (T, 2) world [m]: path at constant heading and speed
    truth: Array | None = None  # (T, 2) world [m]: path that was driven; None if not recorded


@dataclass(frozen=True)
class Light:
    """A traffic light with its state."""

    x: float  # world [m]: middle of its stop lines
    y: float
    open: bool  # green


@dataclass(frozen=True)
class Paths:
    """Trajectory forecasts on a bird's-eye map around the observing agent."""

    observer: tuple[float, float, float]  # x, y, yaw in the world [m, rad]
    reach_m: float  # half the side of the map, which is centred on the observer
    times_s: tuple[float, ...]  # (T,) times of the points of every path, after the present
    users: tuple[RoadUser, ...]
    lights: tuple[Light, ...] = ()

    @property
    def caption(self) -> str:
        """Return the number of road users with a forecast, in words."""
        return f"{len(self.users)} predicted"


Mark = Bars | PictureBoxes | PictureClasses | PictureLines | GroundLines | CloudBoxes | Paths
