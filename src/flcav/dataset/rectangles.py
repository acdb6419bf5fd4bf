"""2D bounding-box labels of an image: of traffic signs and lights, or of actors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Array
from flcav.sensors.frame import Frame
from flcav.world.trace import CATEGORIES

SIGNS = ("stop", "yield", "speed_30", "speed_60", "speed_90", "light_red", "light_yellow", "light_green")
LIGHTS = {"red": "light_red", "red_amber": "light_red", "amber": "light_yellow", "green": "light_green"}
HALF_PX = 0.5  # shift from a frame's pixel coordinates, integers at pixel centres, to those from an image's corner
CLASSES = {"signs": SIGNS, "actors": CATEGORIES}


@dataclass(frozen=True)
class Rectangles:
    """The N labelled 2D bounding boxes of an image."""

    label: NDArray[np.int64]  # (N,) index into the chosen list of CLASSES
    box: Array  # (N, 4) left, top, right, bottom of the visible part [px], from the image's corner
    pixels: NDArray[np.int64]  # (N,) number of visible pixels
    row: NDArray[np.int64]  # (N,) index into the frame's annotations, or into the image's signs

    def __len__(self) -> int:
        return len(self.label)


def select_rectangles(frame: Frame, camera: str, labels: str, min_pixels: int) -> Rectangles:
    """Return the 2D labels of objects with at least `min_pixels` visible pixels in the image of `camera`.

    `labels` is a key of CLASSES. A light that shows red and amber counts as red. Lights that are off, and signs of
    kinds that are not in SIGNS, are left out.
    """
    if labels == "actors":
        views = frame.annotations.views[camera]
        names, box, pixels = frame.annotations.boxes.label.tolist(), views.visible_box, views.pixels
    else:
        signs = frame.annotations.signs[camera]
        names = [LIGHTS.get(state, "") if kind == "signal" else kind for kind, state in zip(signs.kind, signs.state)]
        box, pixels = signs.box, signs.pixels
    number = {name: i for i, name in enumerate(CLASSES[labels])}
    label = np.array([number.get(name, -1) for name in names], np.int64)
    row = np.flatnonzero((label >= 0) & (pixels >= min_pixels))
    return Rectangles(label[row], box[row] + HALF_PX, pixels[row], row)
