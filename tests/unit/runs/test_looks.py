"""The test sweep that a report shows before and after."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.objects.truth import FrameTruth
from flcav.runs.results.tests import SweepTotal
from flcav.runs.stages import testing
from flcav.runs.stages.testing import choose_sweep, detect_before_after


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


def test_the_sweep_that_is_shown_changes_as_all_together_do(monkeypatch: pytest.MonkeyPatch) -> None:
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
    # Of all 8 targets 2 were found and then 7, with 1 false detection and then 2. Frame 5 alone has more found and more
    # false ones.
    assert shown.frame == 5
    assert shown.total == SweepTotal(sweeps=5, targets=8, found=(2, 7), false=(1, 2))
    assert (shown.before.found, shown.after.found) == ((True, False), (True, True))


@pytest.mark.parametrize(
    ("counts", "chosen"),
    [
        ([(4, 1, 3, 1, 0), (4, 2, 3, 1, 0), (4, 2, 4, 2, 1)], 1),  # all change alike: the nearest shares, 5/12 to 10/12
        ([(4, 2, 2, 1, 1), (4, 1, 3, 2, 0), (4, 3, 2, 0, 1)], 1),  # the sums are like none but this
        ([(0, 0, 0, 1, 0), (4, 3, 2, 0, 1)], 1),  # a run that got worse; a sweep without targets shows nothing
        ([(2, 1, 1, 0, 0), (3, 1, 1, 0, 0)], 1),  # nothing changes: 2/5 is nearer to 1/3 than to 1/2
    ],
)
def test_the_rule_of_the_sweep(counts: list[tuple[int, ...]], chosen: int) -> None:
    assert choose_sweep(np.array(counts)) == chosen
