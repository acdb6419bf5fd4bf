"""The test sweep that a report shows before and after."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.objects.truth import FrameTruth
from flcav.runs.stages import testing
from flcav.runs.stages.testing import detect_before_after


def cars(*places: float) -> Boxes:
    rows = np.array([(place, 0, 0, 4, 2, 1.5, 0) for place in places], dtype=np.float64).reshape(-1, 7)
    return Boxes.from_array(rows, "Car", np.ones(len(rows)))


TARGETS = {3: (0, 10), 4: (0, 10, 20), 5: (0, 10), 6: (), 7: (0,)}
FOUND = {  # by frame: before, after
    3: ((), (0, 10)),  # two more
    4: ((0,), (0, 10)),  # one more
    5: ((0,), (0, 10, 40, 50)),  # one more, and two false ones
    6: ((40,), ()),  # nothing was to be found
    7: ((), (0,)),  # one more
}


def test_the_sweep_that_is_shown_is_the_median_by_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    def detect(network: Any, frames: list[int], score_threshold: float) -> list[Boxes]:
        return [cars(*FOUND[frame][network.number]) for frame in frames]

    monkeypatch.setattr(
        testing, "load_stage_network", lambda task, folder: SimpleNamespace(number=int(folder.name), config=None)
    )
    monkeypatch.setattr(
        testing, "asked_of", lambda frame, config: FrameTruth("", cars(*TARGETS[frame]), cars(), cars())
    )
    monkeypatch.setattr(testing, "detect_in", detect)
    split: Any = SimpleNamespace(data=SimpleNamespace(frame=lambda i: i), vehicles=tuple(TARGETS))
    shown = detect_before_after(Path("0"), Path("1"), split)
    assert shown.frame == 4  # gains 2, 1, -1, 1: the median is 1, and this frame has more targets than the other
    assert (shown.before.found, shown.after.found) == ((True, False, False), (True, True, False))
