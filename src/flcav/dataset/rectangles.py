"""The 2D labels of a picture: signs and traffic lights, or actors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.frame import Frame
from flcav.world.trace import CATEGORIES

SIGNS = ("stop", "yield", "speed_30", "speed_60", "speed_90", "light_red", "light_yellow", "light_green")
LIGHTS = {"red": "light_red", "red_amber": "light_red", "amber": "light_yellow", "green": "light_green"}
HALF_PX = 0.5  # a frame's pixels have their centres at whole numbers
CLASSES = {"signs": SIGNS, "actors": CATEGORIES}


@dataclass(frozen=True)
class Rectangles:
    """What shows in one picture."""

    label: NDArray[np.int64]  # (N,) index into the list of CLASSES
    box: NDArray[np.float64]  # (N, 4) left, top, right, bottom of what is visible [px], from the image's corner
    pixels: NDArray[np.int64]  # (N,) that show it
    row: NDArray[np.int64]  # (N,) which of the frame's annotations, or of the picture's signs, it is

    def __len__(self) -> int:
        return len(self.label)


def rectangles(frame: Frame, camera: str, labels: str, min_pixels: int) -> Rectangles:
    """Return what shows at least `min_pixels` of itself in a picture; `labels` is a key of CLASSES.

    Red and amber together is red. Lights that are off, and signs of other kinds, are no objects.
    """
    if labels == "actors":
        views = frame.annotations.views[camera]
        names, box, pixels = frame.annotations.boxes.label.tolist(), views.visible_box, views.pixels
    else:
        signs = frame.annotations.signs[camera]
        names = [LIGHTS.get(state, "") if state else kind for kind, state in zip(signs.kind, signs.state)]
        box, pixels = signs.box, signs.pixels
    number = {name: i for i, name in enumerate(CLASSES[labels])}
    label = np.array([number.get(name, -1) for name in names], np.int64)
    row = np.flatnonzero((label >= 0) & (pixels >= min_pixels))
    return Rectangles(label[row], box[row] + HALF_PX, pixels[row], row)
