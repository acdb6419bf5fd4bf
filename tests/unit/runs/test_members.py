"""A vehicle's part in a group: what it answers, what its messages cost, and what is made of unusable ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from line_task import LineTask, Slope

from flcav.federation.links.link import Replies
from flcav.federation.trainable import Weights
from flcav.fleet.fl_request import make_request
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes, pack_arrays
from flcav.perception.task import Task
from flcav.runs.extras.groups.forming import UNREADABLE, GroupUplink
from flcav.runs.extras.groups.members import (
    ASKS,
    CHECK,
    HELD,
    LOSS,
    MESSAGE,
    OFFER,
    REQUEST,
    SCENE,
    SCORE,
    SKETCH,
    GroupMember,
    Offer,
    Unreadable,
    answer_requests,
    read_loss,
    read_position,
    take_requests,
)

DRIVES = {"weight": np.array([[1.0]], np.float32), "bias": np.array([0.5], np.float32)}  # y = x + 0.5
PLACES = np.array([[np.nan] * 3, [10.0, -3.0, 1.0]])


def member(limit: float, held: Sequence[float] = (1.0, 3.0)) -> GroupMember:
    """Return a member whose network errs by 0.5 - x: its loss is the mean of (x - 0.5)^2."""
    data, own = ([np.float32(each) for each in some] for some in ((0.0, 2.0), held))
    return GroupMember(cast(Task, LineTask()), Slope(), 1, data, own, DRIVES, limit, 7, PLACES)


@pytest.mark.parametrize(("limit", "asks"), [(3.2, True), (3.3, False)])
def test_a_check_is_by_the_loss_on_what_is_held_back(limit: float, asks: bool) -> None:
    found = member(limit).answer(CHECK, {})
    assert {name: array.tolist() for name, array in found.items()} == {
        HELD: [2],
        LOSS: [(0.25 + 6.25) / 2],
        ASKS: [asks],
    }
    nothing = member(-1.0, held=()).answer(CHECK, {})
    assert (nothing[HELD].tolist(), nothing[LOSS].tolist()) == ([0], [0.0])


def test_messages_of_a_member() -> None:
    own = member(1.0)
    request = own.answer(REQUEST, {SCENE: np.array([1])})[MESSAGE].tobytes()
    assert (read_position(request).tolist(), read_loss(request)) == ([10.0, -3.0, 1.0], 3.25)
    better = {"weight": np.array([[2.0]], np.float32), "bias": np.array([1.0], np.float32)}  # errs by 1
    assert read_loss(own.answer(SCORE, better)[MESSAGE].tobytes()) == 1.0
    offer = Offer.read(own.answer(OFFER, {})[MESSAGE].tobytes())
    assert (offer.samples, offer.labels) == (2, {})
    assert np.abs(offer.sketch).max() > 0
    with pytest.raises(ValueError, match="a question for 'weights'"):
        own.answer("weights", {})


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xff" * 90,
        pack_arrays({"samples": np.array([2])}),
        *(
            pack_arrays(
                {
                    "samples": np.array([2]),
                    "labels": np.array([97, 10], np.uint8),
                    "counts": np.array([1]),
                    "sketch": np.ones(SKETCH),
                }
                | each
            )
            for each in (
                {"samples": np.array([0])},
                {"samples": np.array([2, 2])},
                {"sketch": np.ones(SKETCH - 1)},
                {"sketch": np.full(SKETCH, np.nan)},
                {"counts": np.array([1, 1])},
                {"counts": np.array([-1])},
                {"labels": np.array([0xFF, 10], np.uint8)},
            )
        ),
    ],
)
def test_what_is_no_offer(message: bytes) -> None:
    with pytest.raises(Unreadable):
        Offer.read(message)


def uplink(answers: dict[str, Weights], missing: dict[str, str], budget_mb: float = 1.0) -> tuple[GroupUplink, Ledger]:
    book = Ledger(LinkMegabytes(budget_mb, 0.0))

    def ask(question: str, clients: Sequence[str], arrays: Any = None, *, counted: bool = True) -> Replies:
        return Replies(answers, missing)

    return GroupUplink(ask, book, "line"), book


def test_messages_enter_the_ledger_and_who_sends_no_usable_one_is_silent() -> None:
    good = member(1.0).answer(OFFER, {})
    size = good[MESSAGE].size
    own, book = uplink({"a": good, "b": {MESSAGE: np.ones(9, np.uint8)}}, {"c": "out of coverage"})
    assert [*own.hear(OFFER, ["a", "b", "c"], Offer.read)] == ["a"]
    assert [(each.client, each.direction, each.round, each.bytes) for each in book] == [
        ("a", "up", 0, size),
        ("b", "up", 0, 9),
    ]
    assert own.silent["c"] == "out of coverage"
    assert own.silent["b"].startswith(UNREADABLE)
    with pytest.raises(BudgetExceeded):
        uplink({"a": good}, {}, size / 1e6 - 1e-6)[0].hear(OFFER, ["a"], Offer.read)


def test_a_check_is_no_message_on_the_radio() -> None:
    own, book = uplink({"a": member(1.0).answer(CHECK, {}), "b": {HELD: np.zeros(0)}}, {"c": "away"})
    found = own.check(["a", "b", "c"])
    assert [(name, each.held_back, each.before, each.asks) for name, each in found.items()] == [("a", 2, 3.25, True)]
    assert sorted(own.silent) == ["b", "c"]
    assert not book.entries


class Fleet:
    """A deployed fleet with FL requests, of all regions."""

    def __init__(self, waiting: dict[str, tuple[bytes, ...]]) -> None:
        self.waiting, self.answered = waiting, list[bytes]()

    def fleet_of(self, client: str) -> "Fleet":
        return self

    def list_requests(self, clients: Sequence[str], task: str) -> dict[str, tuple[bytes, ...]]:
        return {name: own for name, own in self.waiting.items() if name in clients}

    def answer_requests(self, requests: Sequence[bytes]) -> None:
        self.answered += requests


def test_requests_of_a_step_that_goes_on_are_those_that_it_began_with(tmp_path: Path) -> None:
    sent = [make_request("line", loss, 1, (1.0, 2.0)) for loss in (1.0, 2.0, 3.0)]
    fleet: Any = Fleet({"r/a": (sent[0].as_bytes(), sent[1].as_bytes())})
    taken = take_requests(fleet, tmp_path, ["r/a", "r/b"], "line")
    assert taken.read() == {"r/a": sent[1]}
    answer_requests(fleet, taken, ["r/b"])
    assert fleet.answered == []  # it is no member
    answer_requests(fleet, taken, ["r/b", "r/a"])
    assert fleet.answered == [sent[0].as_bytes(), sent[1].as_bytes()]
    fleet.waiting = {"r/b": (sent[2].as_bytes(),)}  # what came later is for another group
    assert take_requests(fleet, tmp_path, ["r/a", "r/b"], "line") == taken
    assert take_requests(None, tmp_path, ["r/a", "r/b"], "line") == taken  # wherever it goes on
    assert take_requests(None, tmp_path / "other", ["r/a"], "line").messages == {}
