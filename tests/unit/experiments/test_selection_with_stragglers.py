"""Device selection with stragglers: what horizon and budget pay, and rounds of importance selection on the clock."""

import numpy as np
import pytest

from flcav.federation.links.metered import Outage
from flcav.network.ledger import Direction, LedgerEntry
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.reproductions.federation.stragglers.run import (
    ALIKE,
    HORIZON_S,
    IN_TIME,
    PRIMARY,
    ROUNDS,
    SETTINGS,
    WAITS,
    WAYS,
    Course,
    bound_drawn,
    end_within,
    summarise,
    tabulate_stragglers,
    time_drawn,
)
from flcav.runs.driving import AWAY, Fleet

NAMES = tuple(f"ring/cav{number}" for number in range(3))
FLEET = Fleet("ring", NAMES, 1_000_000, 1_000_000, 1.0, {"ring/cav2": 1 / 8})


def links() -> RadioLinks:
    """Return strong links of 20 Mbit/s, on which a megabyte takes 0.4 s."""
    state = np.zeros((31, 3, 1), np.int8)
    loss = np.full(state.shape, 60.0)
    return RadioLinks(
        Radio(), np.arange(0.0, 31.0), ("cav0", "cav1", "cav2"), ("pole1",), np.ones(state.shape), state, loss
    )


def entry(client: str, direction: Direction, size: int) -> LedgerEntry:
    return LedgerEntry("edge", "weather", "wireless", direction, 1, client, size)


def test_a_round_counts_if_it_keeps_both_horizon_and_budget() -> None:
    assert end_within([10, 10, 10], [5, 5, 5], 25, 100) == 2
    assert end_within([10, 10, 10], [5, 5, 5], 100, 12) == 2
    assert end_within([10, 10, 10], [5, 5, 5], 10, 5) == 1
    assert end_within([10], [5], 9, 5) == 0
    with pytest.raises(AssertionError, match="more rounds fit"):
        end_within([10, 10], [5, 5], 20, 10)


def test_the_drawn_send_once_the_slowest_has_reported() -> None:
    reports = [entry(name, direction, 1) for name in NAMES for direction in ("down", "up")]
    assert time_drawn(FLEET, links(), 1, reports) == pytest.approx(8, abs=0.01)
    drawn = [*reports, entry(NAMES[0], "down", 1), entry(NAMES[0], "up", 1_000_000)]
    assert time_drawn(FLEET, links(), 1, drawn) == pytest.approx(8.4, abs=0.01)
    both = [*drawn, entry(NAMES[1], "down", 1), entry(NAMES[1], "up", 1_000_000)]
    assert time_drawn(FLEET, links(), 1, both) == pytest.approx(8.8, abs=0.01)  # they share the band


def test_rounds_of_the_drawn_are_bounded_by_the_slowest_that_is_asked() -> None:
    assert bound_drawn(FLEET, {}) == 1 + int(HORIZON_S / 8)
    without = {(number, NAMES[2]): Outage(AWAY) for number in range(1, ROUNDS + 1)}
    assert bound_drawn(FLEET, without) == ROUNDS


def test_the_primary_claim_stands_alone() -> None:
    def course(reached: float) -> Course:
        return Course((0.0, 10.0), (0.5, reached), 1.0, 10)

    courses = {
        setting: {
            str(seed): {name: course(0.6 + seed / 100 + (0.05 if name == IN_TIME else 0.0)) for name in WAYS}
            for seed in (1, 2, 3)
        }
        for setting in SETTINGS
    }
    found = summarise(320, {"1": ("cav0",), "2": ("cav1",), "3": ("cav2",)}, courses)
    assert found.primary.mean == pytest.approx(0.05)
    assert f"{ALIKE}: {IN_TIME} - {WAITS}" == PRIMARY
    assert PRIMARY not in found.others
    assert len(found.others) == 2 * (len(WAYS) - 1) - 1
    tables = tabulate_stragglers(found)
    assert "| vehicles alike | all, waits | 0.620" in tables["accuracy"]
    assert tables["primary"].count(IN_TIME) == 1
