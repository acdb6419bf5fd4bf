"""Schedules of rounds that wait and of buffers on the same links: equal bytes, equal seconds."""

import numpy as np
import pytest

from flcav.federation.strategies.fedbuff import FedBuff
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.reproductions.federation.asynchrony.run import Rival, Scheduled, schedule_buffers, schedule_rounds
from flcav.runs.driving import Fleet

NAMES = tuple(f"ring/cav{number}" for number in range(3))
FLEET = Fleet("ring", NAMES, 0, 1000, 1.0, {"ring/cav2": 0.2})


def links() -> RadioLinks:
    """Return strong links, on which a kilobyte takes .4 ms, and cav1 absent in the second half of the scene."""
    times = np.arange(0.0, 21.0)
    state = np.zeros((21, 3, 1), np.int8)
    state[10:, 1] = -1
    loss = np.where(state < 0, np.inf, 60.0)
    return RadioLinks(Radio(), times, ("cav0", "cav1", "cav2"), ("pole1",), np.ones(state.shape), state, loss)


def test_rounds_that_wait_take_the_slowest_and_lose_who_leaves() -> None:
    found = schedule_rounds(Rival(), FLEET, [links()], 4)
    assert found.end_s == pytest.approx((5, 10, 15, 20), abs=0.02)
    # the second begins at 5 s with cav1, which is done at 6 s; in the third it is absent
    assert {key: each.reason for key, each in found.outages.items()} == {
        (3, "ring/cav1"): "not in the town",
        (4, "ring/cav1"): "not in the town",
    }
    assert found.up_bytes == (3000, 3000, 2000, 2000)


def test_without_slow_vehicles_rounds_are_short() -> None:
    found = schedule_rounds(Rival(leaves_slow=True), FLEET, [links()], 3)
    assert found.end_s == pytest.approx((1, 2, 3), abs=0.02)
    assert {name for _, name in found.outages} == {"ring/cav2"}


def test_buffers_go_on_until_both_time_and_bytes_are_over() -> None:
    found = schedule_buffers(FedBuff(2), FLEET, [links()], 5.5, 8000)
    assert found.buffers is not None
    assert [dict(each.versions) for each in found.buffers.rounds[:4]] == [
        {"ring/cav0": number, "ring/cav1": number} for number in range(4)
    ]
    assert found.end_s[-1] > 5.5
    assert sum(found.up_bytes) > 8000


def test_what_is_within_a_time_and_bytes() -> None:
    found = Scheduled((1.0, 2.0, 3.0), (10, 10, 10))
    assert [found.last_within(seconds, np.inf) for seconds in (0.5, 1.0, 2.5, 9.0)] == [0, 1, 2, 3]
    assert [found.last_within(np.inf, sent) for sent in (9, 10, 29, 30)] == [0, 1, 2, 3]
