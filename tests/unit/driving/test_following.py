"""Tracks of the closed loop: who is forecast, and where a forecast leads that is older than its track."""

from collections import deque

import numpy as np
import pytest

from flcav.driving.following import _extend, _is_due, _Known, _record, _shift
from flcav.driving.seen import TIMES_S
from flcav.geometry import Boxes
from flcav.perception.trajectory.config import FUTURE, STEP_S
from flcav.perception.trajectory.tracks import OFFSETS_S

VELOCITY = np.array([3.0, -4.0])


def known(*past: tuple[float, float, float]) -> _Known:
    """Return a car that was at (x, y) at times of the past, which are given as time, x, y, and drives by `VELOCITY`."""
    center = np.array([[*past[-1][1:], 0.8]])
    box = Boxes(center, np.array([[4.4, 1.8, 1.6]]), np.zeros(1), np.array(["Car"]))
    return _Known(box, VELOCITY, past[-1][0], deque((*each, 0.0, 5.0) for each in past))


def test_a_forecast_goes_on_at_its_last_velocity():
    present = np.array([20.0, 7.0])
    straight = present + VELOCITY * TIMES_S[:, None]
    np.testing.assert_allclose(_extend(present, straight[1 : FUTURE + 1]), straight, atol=1e-9)


def test_an_old_forecast_begins_where_its_track_is_now():
    """Which was last seen .2 s ago, and is half a metre beside where it was forecast .5 s ago."""
    each = known((9.8, 50.0, 10.0))
    each.forecast, each.forecast_s = np.array([48.5, 12.0]) + VELOCITY * TIMES_S[:, None], 9.5
    path, yaw = _shift(each, 10.0, 1.0)
    np.testing.assert_allclose(path, np.array([50.0, 10.0]) + VELOCITY * (TIMES_S[:, None] + 0.2), atol=1e-9)
    np.testing.assert_allclose(yaw, np.arctan2(-4.0, 3.0))


@pytest.mark.parametrize(("moved", "due"), [((0.0, 0.0), False), ((0.6, 0.0), False), ((0.9, 0.9), True)])
def test_who_stands_is_not_forecast(moved: tuple[float, float], due: bool):
    each = known((0.0, 5.0, -90.0), (2.0, 5.0 + moved[0], -90.0 + moved[1]))
    assert _is_due(each, 2.0) == due


def test_tracks_are_a_trace_of_the_present_and_their_past():
    times = 10.0 + OFFSETS_S
    past = [(time, *(VELOCITY * time).tolist()) for time in np.arange(8.0, 10.05, 0.1).tolist()]
    trace, tracks = _record([known(*past), known(*past)], 10.0, frozenset({"b", "a"}))
    assert [len(each) for each in (trace.time_s, trace.position, trace.velocity, trace.yaw, trace.present)] == [1] * 5
    assert (trace.light.tolist(), trace.light_state.tolist()) == (["a", "b"], [["r", "r"]])
    then = (times <= 10.0) & (times >= 8.0)
    np.testing.assert_allclose(tracks.position[then, 1], VELOCITY * times[then, None], atol=1e-6)
    assert np.isnan(tracks.position[times > 10.0 + 1e-6]).all()
    assert pytest.approx(times[1] - times[0]) == STEP_S
