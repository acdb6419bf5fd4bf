"""Why labels by tracks miss objects, on boxes whose overlaps are known."""

import explain_labels as tool
import numpy as np

from flcav.geometry import Boxes, concatenate


def box(x: float, score: float | None = None) -> Boxes:
    row = np.array([[x, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    return Boxes.from_array(row, "Car", None if score is None else np.array([score]))


def test_each_object_is_labelled_or_has_one_reason():
    targets = concatenate([box(x) for x in (0, 10, 20, 30)])
    tracks = concatenate([box(0.5, 0.9), box(0, 0.4), box(10, 0.4), box(22, 0.9)])
    assert tool.explain(tracks, targets, 0.5) == [tool.LABELLED, tool.FAINT, tool.MISPLACED, tool.NO_TRACK]
    assert tool.explain(tracks, targets, 0.3) == [tool.LABELLED, tool.LABELLED, tool.MISPLACED, tool.NO_TRACK]
