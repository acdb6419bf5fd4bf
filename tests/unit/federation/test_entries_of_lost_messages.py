"""What the ledger has of messages without a reply, and of updates that break off."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, RecordDict
from flwr.supercore.task_identity import TaskIdentity

from flcav.federation.links.in_process import wire_bytes
from flcav.federation.links.metered import Account, MeteredGrid, Outage
from flcav.federation.wire import ARRAYS, CONFIG, LOST, LOST_BY_NETWORK
from flcav.network.ledger import Ledger, LinkMegabytes

NAMES = {1: "a", 2: "b", 3: "c"}


@pytest.fixture(autouse=True)
def _server(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_run_id", 1), ("_node_id", 9), ("_task_id", 1)):
        monkeypatch.setattr(TaskIdentity, name, value)


class Nodes:
    """A grid whose nodes `answering` reply with twice the arrays; it takes all messages before it replies."""

    def __init__(self, answering: Sequence[int]) -> None:
        self.answering, self.got = answering, dict[int, Message]()

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        asked = list(messages)
        for message in asked:
            node = message.metadata.dst_node_id
            self.got[node] = message
            if node in self.answering:
                yield Message(content(40), reply_to=message)


def content(numbers: int, round_: int = 4) -> RecordDict:
    arrays = ArrayRecord({"w": Array(np.zeros(numbers, np.float32))})
    return RecordDict({ARRAYS: arrays, CONFIG: ConfigRecord({"round": round_})})


def messages(*nodes: int) -> list[Message]:
    found = []
    for node in nodes:
        found.append(Message(content(20 + node), dst_node_id=node, message_type="train"))
    return found


def account(outages: Any = None) -> Account:
    return Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "objects", "wireless", outages or {})


def entered(own: Account) -> list[tuple[str, int, str, int]]:
    return [(entry.direction, entry.round, entry.client, entry.bytes) for entry in own.ledger.entries]


def down(client: str) -> tuple[str, int, str, int]:
    node = next(node for node, name in NAMES.items() if name == client)
    return "down", 4, client, wire_bytes(content(20 + node))


@pytest.mark.parametrize("answering", [(1, 2, 3), (2,), (), (3, 1)])
def test_every_message_that_was_sent_is_entered_once_whether_answered_or_not(answering: tuple[int, ...]) -> None:
    own, grid = account(), Nodes(answering)
    replies = list(MeteredGrid(grid, own, NAMES).send_and_receive(messages(1, 2, 3)))  # type: ignore[arg-type]
    assert len(replies) == len(answering)
    down = sorted(entry for entry in entered(own) if entry[0] == "down")
    assert down == [("down", 4, NAMES[node], wire_bytes(content(20 + node))) for node in (1, 2, 3)]
    up = sorted(entry for entry in entered(own) if entry[0] == "up")
    assert up == sorted(("up", 4, NAMES[node], wire_bytes(content(40))) for node in answering)


@pytest.mark.parametrize(("sent", "bytes_"), [(0, 0), (37, 37), (10**6, wire_bytes(content(40)))])
def test_an_update_that_breaks_off_is_entered_as_far_as_it_came(sent: int, bytes_: int) -> None:
    own, grid = account({(4, "b"): Outage("out of coverage", sent)}), Nodes((1, 2, 3))
    replies = list(MeteredGrid(grid, own, NAMES).send_and_receive(messages(1, 2, 3)))  # type: ignore[arg-type]
    assert sorted(entry for entry in entered(own) if entry[2] == "b") == [down("b"), ("up", 4, "b", bytes_)]
    failed = [reply for reply in replies if reply.has_error()]
    assert [(reply.error.code, reply.error.reason) for reply in failed] == [(LOST_BY_NETWORK, "out of coverage")]
    assert [node for node, message in grid.got.items() if LOST in message.content] == [2]


def test_a_node_that_is_away_gets_nothing_and_another_round_loses_nobody() -> None:
    own, grid = account({(4, "b"): Outage("parked"), (5, "c"): Outage("out of coverage", 9)}), Nodes((1, 2, 3))
    replies = list(MeteredGrid(grid, own, NAMES).send_and_receive(messages(1, 2, 3)))  # type: ignore[arg-type]
    assert sorted(grid.got) == [1, 3]
    assert [reply.has_error() for reply in replies] == [False, False, True]
    assert replies[-1].error.reason == "parked"
    assert [entry for entry in entered(own) if entry[2] == "b"] == [down("b")]
    assert own.find_away(4) == {"b": "parked"}
    assert own.find_away(5) == {}
