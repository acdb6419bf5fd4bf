"""2D labels of traffic signs and lights."""

from types import SimpleNamespace
from typing import cast

import numpy as np

from flcav.dataset.rectangles import SIGNS, select_rectangles
from flcav.sensors.frame import Frame, SignViews


def test_lights_for_pedestrians_are_no_lights_for_vehicles() -> None:
    kinds, states = ["stop", "walker_signal", "signal", "signal"], ["", "red", "green", "off"]
    views = SignViews(
        kind=np.array(kinds),
        state=np.array(states),
        box=np.tile([1.0, 2.0, 9.0, 9.0], (4, 1)),
        pixels=np.full(4, 50),
        distance_m=np.full(4, 20.0),
        thing=np.arange(4),
    )
    frame = cast(Frame, SimpleNamespace(annotations=SimpleNamespace(signs={"ahead": views})))
    found = select_rectangles(frame, "ahead", "signs", 1)
    assert [SIGNS[label] for label in found.label] == ["stop", "light_green"]
    assert found.row.tolist() == [0, 2]
