"""Configurations of the sign detector: width, depth, classes, anchors, size of training windows.

The same network also finds cars, in the pictures of roadside cameras: configuration `road`.
"""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from flcav.dataset.rectangles import SIGNS

STRIDES = (8, 16, 32)  # [px] of the three levels' feature maps
Side = Annotated[float, Field(gt=0, le=8192)]
Size = tuple[Side, Side]  # width, height [px]
Window = Annotated[int, Field(ge=32, le=8192)]
Level = tuple[Size, Size, Size]

# Signs are about square, signal heads three times as high as wide.
ANCHORS_PX: tuple[Level, Level, Level] = (
    ((5.0, 8.0), (9.0, 10.0), (8.0, 20.0)),
    ((16.0, 17.0), (14.0, 34.0), (26.0, 27.0)),
    ((26.0, 62.0), (45.0, 47.0), (80.0, 90.0)),
)

# Cars some 10 to 60 m from a camera of 90 degrees on a pole are wider than high, seen from the front nearly square.
CAR_ANCHORS_PX: tuple[Level, Level, Level] = (
    ((14.0, 9.0), (22.0, 13.0), (36.0, 18.0)),
    ((34.0, 30.0), (56.0, 26.0), (62.0, 44.0)),
    ((100.0, 48.0), (110.0, 90.0), (210.0, 100.0)),
)


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class SignsConfig:
    """Configuration of a sign detector, which takes images of any size; lengths are in pixels of the image."""

    width: Annotated[float, Field(gt=0, le=4)]  # factor of the numbers of channels, see `signs.model.CHANNELS`
    depth: Annotated[float, Field(gt=0, le=4)]  # factor of the numbers of bottlenecks, see `signs.model.DEPTHS`
    labels: Literal["signs", "actors"] = "signs"  # what is to be found: a key of `flcav.dataset.rectangles.CLASSES`
    classes: Annotated[tuple[str, ...], Field(min_length=1)] = SIGNS  # of these labels, in the order of the scores
    anchors_px: tuple[Level, Level, Level] = ANCHORS_PX  # width, height of the anchors at each of STRIDES
    background: bool = False  # whether its input is a picture beside the static background: see `signs.background`
    window_px: tuple[Window, Window] = (320, 192)  # width, height of a training sample
    smallest_px: Annotated[float, Field(ge=0, le=8192)] = 6.0  # least size, root of the area, of a target box


CONFIGURATIONS = {
    "n": SignsConfig(width=0.25, depth=0.33),
    "s": SignsConfig(width=0.5, depth=0.33),
    "road": SignsConfig(
        width=0.125,
        depth=0.33,
        labels="actors",
        classes=("car", "van"),
        anchors_px=CAR_ANCHORS_PX,
        background=True,
        smallest_px=10.0,
    ),
}
