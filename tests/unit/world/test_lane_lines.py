"""Lane lines of a map: doubles become one line, and pieces that follow each other are joined."""

import numpy as np
import pytest

from flcav.world.map.lane_lines import STEP_M, join_lane_lines
from flcav.world.map.lanes import map_layers
from flcav.world.map.layers import Marking
from flcav.world.map.town import load_town


def marking(kind, *points, width=0.12):
    return Marking(kind, np.array(points, float), width, 3.0 if kind == "dashed" else 0.0, 6.0)


def test_both_lines_of_a_double_one_are_one_line_between_them():
    (line,) = join_lane_lines([marking("solid", (0, 0.12), (20, 0.12)), marking("solid", (0, -0.12), (20, -0.12))])
    assert np.abs(line.points[:, 1]).max() < 1e-9
    assert line.width_m == pytest.approx(0.36)
    assert line.solid.all()


def test_a_dashed_line_goes_on_as_the_solid_one_behind_it_whatever_their_directions():
    pieces = [marking("solid", (30, 0), (20, 0)), marking("dashed", (0, 0), (20, 0)), marking("edge", (0, 3), (30, 3))]
    lines = sorted(join_lane_lines(pieces), key=lambda line: line.points[0, 1])
    assert len(lines) == 2
    ends = sorted(lines[0].points[[0, -1], 0].tolist())
    assert ends == [0, 30]
    at = lines[0].points[:, 0]
    assert (lines[0].solid == (at > 20))[np.abs(at - 20) > 1e-6].all()
    assert np.hypot(*np.diff(lines[0].points, axis=0).T).max() <= STEP_M + 1e-9


def test_lines_that_meet_at_an_angle_and_lines_across_are_not_joined():
    pieces = [
        marking("solid", (0, 0), (20, 0)),
        marking("solid", (20, 0), (20, 20)),
        marking("stop_line", (0, 1), (3, 1)),
    ]
    assert len(join_lane_lines(pieces)) == 2


def test_a_town_s_lines_are_as_long_as_its_markings_without_the_second_of_a_double():
    layers = map_layers(load_town("suburb"))
    lines = join_lane_lines(layers.markings)
    along = sum(
        np.hypot(*np.diff(m.line, axis=0).T).sum() for m in layers.markings if m.kind in ("solid", "dashed", "edge")
    )
    length = sum(np.hypot(*np.diff(line.points, axis=0).T).sum() for line in lines)
    assert len(lines) < len(layers.markings)
    assert length == pytest.approx(along, rel=0.02)  # the suburb has no double lines
