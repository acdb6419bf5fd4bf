"""What a client answers: each round once, in order, as agreed, within its budget; and never with other noise."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flwr.app import ConfigRecord, Message, MessageType, RecordDict

from flcav.federation.client import client_app
from flcav.federation.messages.conduct import ANSWERED
from flcav.federation.messages.records import ARRAYS, ASK, CONFIG, LOST, read_arrays, to_arrays
from flcav.federation.noise import draw_secret
from flcav.federation.privacy import Privacy, account_epsilon
from flcav.federation.rounds import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.metered import Account
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.scaffold import Scaffold
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Ledger, LinkMegabytes

START = {"w": np.zeros(50, np.float32)}
SCHEDULE = Schedule(9, 1, 0.1, 0.1, 1)
RULES: dict[str, dict[str, Any]] = {
    "plain": {},
    "local": {"privacy": {"where": "local", "clip": 1, "noise": 4}},
    "unbiased": {"selection": {"rule": "uniform", "clients": 1, "unbiased": True}},
    "importance": {"selection": {"rule": "importance", "clients": 1}},
    "secure": {"secure": {}},
    "noise and masks": {"secure": {}, "privacy": {"where": "local", "clip": 1, "noise": 4}},
}


class Vehicle:
    def train(self, weights: Weights, *, seed: int, **_: Any) -> LocalUpdate:
        return LocalUpdate({"w": weights["w"] + np.float32(seed % 7 + 1)}, 37, 0.1, gradient={"w": weights["w"] + 1})

    def count_samples(self, steps: int) -> int:
        return 37


class Server:
    """A server that asks the first of two clients whatever it likes."""

    def __init__(self, grid: EmbeddedGrid) -> None:
        self.grid = grid

    def ask(self, asked: str | None, round_: int = 1, start: Weights = START, seed: int | None = None, **more: Any):
        """Return the answer to a request; more: entries of a request of secure aggregation."""
        work = SCHEDULE.work(round_)
        records: dict[str, Any] = {CONFIG: (work if seed is None else replace(work, seed=seed)).record()}
        records[ARRAYS] = to_arrays(start)
        if asked is not None:
            records[ASK] = ConfigRecord({ASK: asked, **more})
        return self.send(records)

    def send(self, records: dict[str, Any], kind: str = MessageType.TRAIN) -> RecordDict:
        (reply,) = self.grid.send_and_receive([Message(RecordDict(records), 2, kind)])
        if reply.has_error():
            raise ConnectionRefusedError(reply.error.reason)
        return reply.content

    def refuses(self, *asked: Any, **how: Any) -> None:
        with pytest.raises(ConnectionRefusedError, match="RequestRefused"):
            self.ask(*asked, **how)


@contextmanager
def serve(name: str, strategy: Strategy = FEDAVG, spent: int = 0, **privacy: Any) -> Iterator[Server]:
    rules = Rules.model_validate(RULES[name])
    if privacy:
        assert rules.privacy is not None
        rules = rules.model_copy(update={"privacy": rules.privacy.model_copy(update=privacy)})
    clients = {"cav0": Vehicle(), "cav1": Vehicle()}
    secrets = {client: draw_secret() for client in clients}
    with EmbeddedGrid(client_app(clients, strategy, rules, secrets, spent), [*clients]) as grid:
        yield Server(grid)


def update(content: RecordDict) -> np.ndarray:
    return read_arrays(content, ARRAYS)["w"]


AGREED = {  # requests of a round, in order; None asks for the update
    "plain": [None],
    "local": [None],
    "unbiased": ["count", None],
    "importance": ["norm", "send"],
    "secure": ["keys"],  # what follows needs keys of others
    "noise and masks": ["keys"],
}


@pytest.mark.parametrize("name", RULES)
def test_requests_out_of_order_or_of_another_kind_are_refused(name: str):
    agreed = AGREED[name]
    for other in {None, "count", "norm", "send", "keys", "anything"} - {*agreed}:
        with serve(name) as server:
            server.refuses(other)
    for late in agreed[1:]:
        with serve(name) as server:
            server.refuses(late)  # as the first
    with serve(name) as server:
        for round_ in (1, 2, 4):
            for asked in agreed:
                server.ask(asked, round_)
        for round_ in (1, 2, 3):
            for asked in agreed:
                server.refuses(asked, round_)
        server.ask(agreed[0], 5)
        for asked in agreed[1:]:
            server.refuses(asked, 4)


@pytest.mark.parametrize("name", ["plain", "local"])
def test_the_same_request_gets_the_same_bytes_and_another_one_of_the_round_none(name: str):
    with serve(name) as server:
        first = server.ask(None)
        np.testing.assert_array_equal(update(server.ask(None)), update(first))  # after a stop of the server
        server.refuses(None, seed=5)
        server.refuses(None, start={"w": START["w"] + 1})
        second = server.ask(None, 2)
        assert name == "plain" or not np.array_equal(update(first), update(second))


def test_noise_cannot_be_averaged_away():
    with serve("local") as server:
        server.ask(None)
        answered = 0
        for seed in range(300):
            try:
                server.ask(None, seed=seed)
                answered += 1
            except ConnectionRefusedError:
                pass
        assert not answered


def test_a_client_that_keeps_something_answers_a_request_once():
    with serve("plain", Scaffold()) as server:
        extra = {"extra": to_arrays({"w": START["w"]})}
        work = {CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_arrays(START)}
        server.send(work | extra)
        with pytest.raises(ConnectionRefusedError, match="after update of round 1 was answered"):
            server.send(work | extra)


def test_a_note_that_nothing_arrives_is_no_other_request():
    with serve("plain") as server:
        server.send({CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_arrays(START), LOST: ConfigRecord()})
        server.ask(None)


def test_a_client_s_own_budget_ends_its_answers():
    privacy = Privacy(where="local", clip=1, noise=4, epsilon=8)
    most = max(n for n in range(1, 30) if account_epsilon(privacy, Selection(), ["cav0"], n) <= 8)
    assert most > 2
    with serve("local", epsilon=8.0) as server:
        for round_ in range(1, most + 1):
            server.ask(None, round_)
        with pytest.raises(
            ConnectionRefusedError, match=f"more than the {most} that the privacy budget of cav0 affords"
        ):
            server.ask(None, most + 1)
    with serve("local", epsilon=8.0, spent=most - 1) as server:
        server.ask(None, 1)
        server.refuses(None, 2)


def test_masks_are_for_one_update_and_a_round_that_is_unmasked_does_not_begin_anew():
    with serve("secure") as server:
        names = ["cav0", "cav1"]
        keys = [server.ask("keys").config_records[ASK], None]
        (reply,) = server.grid.send_and_receive(
            [Message(RecordDict({CONFIG: SCHEDULE.work(1).record(), ASK: ConfigRecord({ASK: "keys"})}), 3, "train")]
        )
        keys[1] = reply.content.config_records[ASK]
        both = {kind: [each[kind] for each in keys if each] for kind in ("ciphers", "masks")}

        def share(threshold: int, names: list[str], **keys: Any) -> Any:
            return server.ask("shares", names=names, threshold=threshold, **keys)

        server.refuses("masked", names=["cav1"], shares=[bytes(148)])
        share(2, names, **both)
        server.refuses("shares", names=names, threshold=2, **both)  # by keys that have sealed a message
        server.ask("keys")  # anew, as others' shares did not open
        with pytest.raises(ConnectionRefusedError, match="in the place of this client's own"):
            share(2, names, **both)


def test_a_threshold_below_that_agreed_on_is_refused():
    rules = Rules.model_validate({"secure": {"threshold": 4}})
    names = [f"cav{i}" for i in range(5)]
    with EmbeddedGrid(client_app({name: Vehicle() for name in names}, FEDAVG, rules), names) as grid:
        server, work = Server(grid), SCHEDULE.work(1).record()
        asked = [
            Message(RecordDict({CONFIG: work, ASK: ConfigRecord({ASK: "keys"})}), node, "train") for node in grid.names
        ]
        keys = [reply.content.config_records[ASK] for reply in grid.send_and_receive(asked)]
        about: dict[str, Any] = {kind: [each[kind] for each in keys] for kind in ("ciphers", "masks")}
        with pytest.raises(ConnectionRefusedError, match="a threshold of 3 of 5 clients: 4 are agreed on"):
            server.ask("shares", names=names, threshold=3, **about)


def test_a_query_plants_nothing_in_a_client():
    with serve("secure") as server:
        for _ in range(2):
            with pytest.raises(ConnectionRefusedError, match="a client's state is its own"):
                server.send({"secrets": ConfigRecord({"secrets": "planted"})}, MessageType.QUERY)
            server.ask("keys")
        with pytest.raises(ConnectionRefusedError, match="a client's state is its own"):
            server.send({ANSWERED: to_arrays({ANSWERED: np.zeros(7, np.int64)})}, MessageType.QUERY)
        server.send({}, MessageType.QUERY)


@pytest.mark.parametrize("name", ["local", "secure"])
def test_what_was_answered_is_kept_with_the_state(name: str):
    clients = {f"cav{i}": Vehicle() for i in range(3)}
    rules, account = (
        Rules.model_validate(RULES[name]),
        Account(Ledger(LinkMegabytes(9.0, 9.0)), "edge", "toy", "wireless"),
    )
    state = FederationState()
    federate(clients, START, replace(SCHEDULE, rounds=2), account, rules=rules, state=state)
    assert {client: kept[ANSWERED][ANSWERED][0] for client, kept in state.clients.items()} == dict.fromkeys(clients, 2)
    again = FederationState(secrets=state.secrets)
    again.restore(state.to_arrays(), state.records)
    federate(clients, START, replace(SCHEDULE, rounds=3), account, rules=rules, state=again, done=2)
    assert again.records[-1].clients == tuple(clients)
    with pytest.raises(OSError, match=r"RequestRefused.*of round 1, after .* of round 3 was answered"):
        federate(clients, START, replace(SCHEDULE, rounds=1), account, rules=rules, state=again)
