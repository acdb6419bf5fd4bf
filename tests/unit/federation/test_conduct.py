"""What a client answers: each round once, in order, as agreed, within its budget; and never with other noise."""

import contextlib
import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flwr.app import ConfigRecord, Message, MessageType, RecordDict
from flwr.common.serde import recorddict_to_proto

from flcav.federation.client import client_app
from flcav.federation.conduct import ANSWERED
from flcav.federation.links.in_process import EmbeddedGrid
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy, account_epsilon, draw_secret
from flcav.federation.rules import Rules
from flcav.federation.secure.messages import SecureSum, TooFewClients
from flcav.federation.secure.parties import PublicKeys, SecureClient, add_mask
from flcav.federation.secure.primitives import SHARE_BYTES, agree, join_shares, to_values
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.wire import ARRAYS, ASK, CONFIG, LOST, VECTOR, read_arrays, to_array_record
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import SentOutputs
from flcav.statistics.streams import derive_seed

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
        records[ARRAYS] = to_array_record(start)
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
            server.refuses(late, 0)  # of the round that a client has answered last before its first
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
        extra = {"extra": to_array_record({"w": START["w"]})}
        work = {CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_array_record(START)}
        server.send(work | extra)
        with pytest.raises(ConnectionRefusedError, match="after update of round 1 was answered"):
            server.send(work | extra)


def test_a_note_that_nothing_arrives_is_no_other_request():
    with serve("plain") as server:
        server.send({CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_array_record(START), LOST: ConfigRecord()})
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
            server.send({ANSWERED: to_array_record({ANSWERED: np.zeros(7, np.int64)})}, MessageType.QUERY)
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


class LyingServer:
    """A server of secure aggregation that invents two of three clients, and so takes off the masks of the third."""

    def __init__(self, server: Server) -> None:
        self.server = server

    def learn(self, round_: int, seed: int | None = None, start: Weights = START) -> np.ndarray:
        """Return the first client's update in a round, which may have begun before."""
        keys = self.server.ask("keys", round_, start, seed).config_records[ASK]
        names, own = ["cav0", "e1", "e2"], PublicKeys(keys["ciphers"], keys["masks"])  # type: ignore[arg-type]
        evil = {name: SecureClient.draw(name) for name in names[1:]}
        peers = {"cav0": own} | {name: each.keys for name, each in evil.items()}
        kinds = {"ciphers": [each.cipher for each in peers.values()], "masks": [each.mask for each in peers.values()]}
        shared: Any = self.server.ask("shares", round_, start, seed, names=names, threshold=2, **kinds).config_records[
            ASK
        ]
        sealed = dict(zip(shared["names"], shared["shares"], strict=True))
        for name, each in evil.items():
            each.share(peers, 2)
            assert not each.take({"cav0": sealed[name]})
        junk = [evil[name].share(peers, 2)["cav0"] for name in evil]
        answer = self.server.ask("masked", round_, start, seed, names=[*evil], shares=junk)
        masked = read_arrays(answer, ARRAYS)[VECTOR].astype(np.uint32)
        shares = {place: each.opened["cav0"][:SHARE_BYTES] for place, each in enumerate(evil.values(), 1)}
        masked = add_mask(masked, join_shares(shares), plus=False)
        for name, each in evil.items():
            masked = add_mask(masked, agree(each.private, own.mask, "mask"), plus=name < "cav0")
        return to_values(masked, 8.0, 3)


def test_a_round_of_masks_that_restarts_hides_the_same_noisy_update_and_no_other():
    """Of an update the server learns what one answer tells, however often it begins the round anew."""
    with serve("noise and masks") as server:
        liar = LyingServer(server)
        first = liar.learn(1)
        assert np.std(first) > 1  # with noise of 4
        for _ in range(20):
            np.testing.assert_array_equal(liar.learn(1), first)
        for other in ({"seed": 5}, {"start": {"w": START["w"] + 1}}):
            with pytest.raises(ConnectionRefusedError, match="another training of round 1 than that whose update"):
                liar.learn(1, **other)  # type: ignore[arg-type]
        np.testing.assert_array_equal(liar.learn(1), first)
        assert not np.array_equal(liar.learn(2, seed=5), first)
        server.refuses("keys", 1)


def test_an_update_under_masks_is_trained_once_in_a_round(monkeypatch: pytest.MonkeyPatch):
    trained: list[int] = []
    train = Vehicle.train

    def drifting(self: Vehicle, weights: Weights, *, seed: int, **how: Any) -> LocalUpdate:
        """Train as on a machine whose sums come out differently each time."""
        trained.append(seed)
        found = train(self, weights, seed=seed)
        return LocalUpdate({"w": found.weights["w"] + np.float32(1e-6) * len(trained)}, 37, 0.1)

    monkeypatch.setattr(Vehicle, "train", drifting)
    for name in ("secure", "noise and masks"):
        trained.clear()
        with serve(name) as server:
            liar = LyingServer(server)
            first = liar.learn(1)
            assert name != "secure" or first == pytest.approx(trained[0] % 7 + 1, abs=1e-5)  # it does take masks off
            for _ in range(5):
                np.testing.assert_array_equal(liar.learn(1), first)
            assert len(trained) == 1
            liar.learn(2)
            assert len(trained) == 2


def test_clients_know_how_many_a_round_of_masks_needs(monkeypatch: pytest.MonkeyPatch):
    """A server that shows a client of five two of them is refused: three are needed."""
    agree_ = SecureSum.agree

    def showing_few(self: SecureSum, chosen: list[str]) -> Any:
        self._threshold = 2
        return agree_(self, chosen[:2])

    clients = {f"cav{i}": Vehicle() for i in range(5)}
    federate(clients, START, replace(SCHEDULE, rounds=1), rules=Rules.model_validate({"secure": {}}))
    monkeypatch.setattr(SecureSum, "agree", showing_few)
    with pytest.raises(TooFewClients, match="0 clients shared their secrets"):
        federate(clients, START, replace(SCHEDULE, rounds=1), rules=Rules.model_validate({"secure": {}}))


class Imitator:
    """A client of FedMD: it sends outputs, and keeps a network."""

    def train(self, weights: Weights, *, own: Weights | None = None, **_: Any) -> Any:
        network = {"net": own["net"] + 1 if own else np.full(5, 7.0, np.float32)}
        return SentOutputs({"p": weights["p"] + 1}, 3, 0.1, network)


def test_no_request_gets_the_network_of_a_client_that_sends_outputs():
    strategy, network = FedMD(), np.full(5, 7.0, np.float32)
    with EmbeddedGrid(client_app({"cav0": Imitator()}, strategy, Rules()), ["cav0"]) as grid:
        server, told = Server(grid), list[RecordDict]()
        told.append(server.send({CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_array_record({"p": np.zeros((4, 3))})}))
        assert np.array_equal(grid.read_states(["own"])["cav0"]["own"]["net"], network)
        for kind in (MessageType.TRAIN, MessageType.QUERY, MessageType.EVALUATE, "query.ask", "query.own", "train.own"):
            for content in (
                {},
                {"own": ConfigRecord()},
                {ASK: ConfigRecord({ASK: "own"})},
                {"own": to_array_record({})},
            ):
                for key in ({}, {CONFIG: SCHEDULE.work(2).record()}):
                    with contextlib.suppress(ConnectionRefusedError, ValueError):
                        told.append(server.send({**content, **key}, kind))
        assert len(told) > 1  # a query is answered
        for content in told:
            assert "own" not in content
            for key in content.array_records:
                for array in read_arrays(content, key).values():
                    assert not (array.size == 5 and np.array_equal(array, network))
            assert network.tobytes() not in recorddict_to_proto(content).SerializeToString()


@pytest.mark.parametrize("name", ["secure", "noise and masks", "local"])
def test_no_request_gets_an_update_without_its_masks_or_noise(name: str):
    """Whatever kind of message asks, whatever for, before, during and after a round: the change is in no answer."""
    change = np.float32(derive_seed(SCHEDULE.work(1).seed, "cav0") % 7 + 1)
    plain, told = np.full(50, change, np.float32).tobytes(), list[RecordDict]()
    kinds = (MessageType.TRAIN, MessageType.QUERY, MessageType.EVALUATE, "query.ask", "train.plain")
    with serve(name) as server:

        def try_all(round_: int) -> None:
            for kind, asked in itertools.product(kinds, (None, "norm", "send", "count", "unmask", "update", "shares")):
                ask = {} if asked is None else {ASK: ConfigRecord({ASK: asked})}
                for more in ({}, {ARRAYS: to_array_record(START), CONFIG: SCHEDULE.work(round_).record()}):
                    with contextlib.suppress(ConnectionRefusedError, ValueError):
                        told.append(server.send({**ask, **more}, kind))

        try_all(1)
        if name != "local":
            LyingServer(server).learn(2)
            try_all(2)
            server.ask("keys", 3)
            try_all(3)
    assert told
    assert not any(plain in recorddict_to_proto(content).SerializeToString() for content in told)


class Whole:
    """A client that returns all arrays and gradients, whatever layers it is asked to train."""

    def train(self, weights: Weights, **_: Any) -> LocalUpdate:
        moved = {name: array + np.float32(1) for name, array in weights.items()}
        return LocalUpdate(moved, 3, 0.1, {name: array + np.float32(2) for name, array in weights.items()})


@pytest.mark.parametrize("strategy", [FEDAVG, Scaffold()])
def test_arrays_that_are_not_sent_stay_with_their_gradients(strategy: Strategy):
    rules, start = (
        Rules.model_validate({"upload": {"layers": ["head.*"]}}),
        {"head.w": np.zeros(3), "body.w": np.zeros(4)},
    )
    with EmbeddedGrid(client_app({"cav0": Whole()}, strategy, rules), ["cav0"]) as grid:
        content = {CONFIG: SCHEDULE.work(1).record(), ARRAYS: to_array_record(start), "extra": to_array_record(start)}
        told = Server(grid).send(content)
        for key in told.array_records:
            assert {*told.array_records[key]} == {"head.w"}
        assert len([*told.array_records]) == (1 if strategy is FEDAVG else 2)
        state = grid.read_states(["own", "residual"])
        assert {name for kinds in state.values() for arrays in kinds.values() for name in arrays} <= {"head.w"}
