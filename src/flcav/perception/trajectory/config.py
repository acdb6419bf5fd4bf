"""Configurations of the trajectory network: modes, sizes, patch of ground, cameras; and the instants of a track."""

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
STEP_S = 0.25  # time between two points of a track
PAST, FUTURE = 8, 12  # steps before and after the present: 2 s and 3 s
Maps = Annotated[int, Field(ge=1, le=4096)]  # number of feature maps


@dataclass(frozen=True, config=STRICT)
class Patch:
    """The square of ground that the network sees, in the frame of the predicted road user: x ahead, y to the left."""

    cells: Annotated[int, Field(ge=16, le=1024, multiple_of=8)] = 64  # along each side
    cell_m: Annotated[float, Field(ge=1e-3, le=1e3)] = 1.0  # side of a cell
    ahead: Annotated[float, Field(gt=0, lt=1)] = 0.75  # share of the patch that lies ahead of the road user

    @property
    def side_m(self) -> float:
        """Return the length of a side [m]."""
        return self.cells * self.cell_m

    @property
    def middle_x_m(self) -> float:
        """Return the x coordinate of the patch's centre [m]."""
        return (self.ahead - 0.5) * self.side_m


@dataclass(frozen=True, config=STRICT)
class CrossView:
    """Configuration of the cross-view transformer, from images of several cameras to features on the ground."""

    width_px: Annotated[int, Field(ge=32, le=8192, multiple_of=16)] = 96  # images are resized to this
    height_px: Annotated[int, Field(ge=32, le=8192, multiple_of=16)] = 48
    features: Annotated[int, Field(ge=8, le=4096, multiple_of=8)] = 32  # width of the embeddings
    heads: Annotated[int, Field(ge=1, le=64)] = 2  # attention heads
    layers: Annotated[int, Field(ge=1, le=64)] = 1  # attention layers
    queries: Annotated[int, Field(ge=4, le=256)] = 16  # along each side of the patch
    map_weight: Annotated[float, Field(ge=0, le=1e6)] = 8.0  # weight of the map segmentation in the loss


@dataclass(frozen=True, config=STRICT)
class TrajectoryConfig:
    """Configuration of the LSTM encoder-decoder, whose bird's-eye view is computed from rasters or from cameras."""

    modes: Annotated[int, Field(ge=1, le=256)] = 6  # of a forecast, K
    hidden: Annotated[int, Field(ge=8, le=4096)] = 64  # size of the hidden state of both LSTMs
    maps: tuple[Maps, Maps, Maps] = (16, 32, 32)  # feature maps of the convolutions of the bird's-eye view
    patch: Patch = Patch()
    cameras: CrossView | None = None  # None: rasters


CONFIGURATIONS = {
    "tiny": TrajectoryConfig(),
    "tiny-cameras": TrajectoryConfig(cameras=CrossView()),
    "paper": TrajectoryConfig(hidden=256, maps=(32, 64, 128), patch=Patch(cells=128, cell_m=0.5)),
    "paper-cameras": TrajectoryConfig(
        hidden=256,
        maps=(32, 64, 128),
        patch=Patch(cells=200, cell_m=0.5),
        cameras=CrossView(width_px=480, height_px=224, features=128, heads=4, layers=2, queries=25),
    ),
}
