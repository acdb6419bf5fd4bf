"""The server of a fleet believes no vehicle: what one claims costs it the round, and nobody else.

Vehicles answer by their apps, in folders of their own, in the place of a SuperLink that would carry the messages.
"""

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from flwr.app import ConfigRecord, Context, Error, Message, RecordDict
from flwr.supercore.task_identity import TaskIdentity

from flcav.federation.client import ClientAgreement
from flcav.federation.exchange import ClientFailed
from flcav.federation.links.flower_grid import DeployedGrid
from flcav.federation.links.in_process import keep_identity, wire_bytes
from flcav.federation.links.link import open_link
from flcav.federation.links.metered import Account
from flcav.federation.links.vehicle_app import Assignment, VehicleApp, load_identity
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.secure.parties import SEALED_BYTES, PublicKeys
from flcav.federation.secure.primitives import draw_keys
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.strategy import Strategy
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.wire import ASK, LOST_BY_NETWORK, NAMES, OVER_BUDGET, SHARES, to_array_record
from flcav.fleet.authority import found_authority, open_registry
from flcav.fleet.keys import AUTHORITY, request_certificate, take_certificate
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes

START = {"w": np.zeros((4, 3), np.float32), "b": np.zeros(700)}
VEHICLES, FIRST = 3, 2
Lie = Callable[[Message, Message], Message]  # of a request and its answer, what is sent in its place


class Vehicle:
    def train(self, weights: Weights, **_: Any) -> LocalUpdate:
        return LocalUpdate({name: array + np.asarray(1, array.dtype) for name, array in weights.items()}, 5, 0.1)

    def count_samples(self, steps: int) -> int:
        return 5

    def answer(self, question: str, arrays: Weights) -> Weights:
        return {question: np.ones(3)}


class Apps:
    """The link of a fleet, whose vehicles answer in this process; one of them lies."""

    def __init__(self, folder: Path, lies: dict[int, Lie]) -> None:
        self.folder, self.lies, self._answers, self._sent = folder, lies, dict[str, Message](), 0
        self.grid, self.id = self, 1

    def wait(self, seconds: float) -> None:
        pass

    def begin(self) -> "Apps":
        return self

    def identify(self) -> None:
        TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = 1

    def end(self, failed: bool = False) -> None:
        pass

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        found = []
        for message in messages:
            self._sent += 1
            found.append(str(self._sent))
            message.metadata.__dict__["_message_id"] = found[-1]
            node = message.metadata.dst_node_id
            try:
                answer = VehicleApp(self.folder / f"v{node}")(message, Context(1, node, {}, RecordDict(), {}))
            except Exception as error:
                answer = Message(Error(2, repr(error)), reply_to=message)
            self._answers[found[-1]] = self.lies[node](message, answer) if node in self.lies else answer
        return found

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        return [self._answers.pop(each) for each in message_ids]


class Fleet:
    """A deployed runtime without sockets."""

    deployed: Literal[True] = True

    def __init__(self, folder: Path, lies: dict[int, Lie]) -> None:
        self.folder, self.link = folder, Apps(folder, lies)

    @contextlib.contextmanager
    def open(self, clients: Any, agreed: ClientAgreement, states: Any, account: Account) -> Iterator[DeployedGrid]:
        names = dict(enumerate(clients, FIRST))
        for node, name in names.items():
            state = states.get(name, {})
            own = (clients[name], agreed.strategy, agreed.rules, agreed.secrets.get(name), agreed.spent, state)
            Assignment("f", name, *own).save(self.folder / f"v{node}")
        with keep_identity():
            link: Any = self.link
            with contextlib.closing(open_registry(self.folder)) as registry:
                vehicles = {int(own.name[1:]): own for own in registry.list_vehicles()}
            yield DeployedGrid(self.folder, link, names, {node: vehicles[node] for node in names}, account)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    authority = found_authority(tmp_path_factory.mktemp("fleet"))
    for node in range(FIRST, FIRST + VEHICLES):
        own = authority.folder / f"v{node}"
        certificate = authority.register(request_certificate(own, f"v{node}"))
        take_certificate(own, certificate, (authority.folder / AUTHORITY).read_bytes())
    authority.registry.close()
    return authority.folder


def with_code(code: int) -> Lie:
    return lambda asked, answer: Message(Error(code, "an answer of 2 bytes, and 1 are left"), reply_to=asked)


def enlarge(asked: Message, answer: Message) -> Message:
    content = RecordDict({**answer.content, "junk": to_array_record({"junk": np.zeros(10**6)})})
    return Message(content, reply_to=asked)


LIES: dict[str, tuple[Lie, str]] = {
    "over the budget": (with_code(OVER_BUDGET), r"no answer, as if \d+ bytes were too few for it"),
    "lost by the network": (with_code(LOST_BY_NETWORK), "an answer of 2 bytes, and 1 are left"),
    "unknown": (with_code(0), "an answer of 2 bytes, and 1 are left"),
    "of no meaning": (with_code(-7), "an answer of 2 bytes, and 1 are left"),
    "large": (enlarge, r"an answer of 8\d+ bytes, where \d+ were granted"),
}
RULES: dict[str, dict[str, Any]] = {
    "plain": {},
    "importance": {"selection": {"rule": "importance", "clients": 3}},
    "unbiased": {"selection": {"rule": "uniform", "clients": 3, "unbiased": True}},
    "local noise": {"privacy": {"where": "local", "clip": 1, "noise": 0.1, "seeded": True}},
    "masks": {"secure": {}},
    "buffers": {},
}


def run(
    folder: Path, lies: dict[int, Lie], rules: str = "plain", megabytes: float = 99.0, rounds: int = 2
) -> tuple[FederationState, Ledger]:
    state, book = FederationState(), Ledger(LinkMegabytes(megabytes, 0))
    clients, account = {f"cav{i}": Vehicle() for i in range(VEHICLES)}, Account(book, "edge", "toy", "wireless")
    strategy: Strategy = FedBuff(VEHICLES) if rules == "buffers" else FEDAVG
    how: Any = {"rules": Rules.model_validate(RULES[rules]), "strategy": strategy, "runtime": Fleet(folder, lies)}
    found = federate(clients, START, Schedule(rounds, 1, 0.1, 0.1, 1), account, state=state, **how)
    assert all(np.isfinite(array).all() for array in found.weights.values())
    return state, book


@pytest.fixture(autouse=True)
def _without_a_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flcav.storage.files._flush", lambda path: None)


@pytest.mark.parametrize(
    ("rules", "lie", "liar"),
    [
        *(("plain", lie, 0) for lie in LIES),
        *((rules, lie, 2) for rules in RULES for lie in ("over the budget", "large")),
    ],
)
def test_a_lie_costs_its_vehicle_the_round(folder: Path, rules: str, lie: str, liar: int):
    state, book = run(folder, {FIRST + liar: LIES[lie][0]}, rules)
    for record in state.records:
        assert record.failed.keys() == {f"cav{liar}"}
        assert re.search(LIES[lie][1], record.failed[f"cav{liar}"])
        assert {*record.clients} == {f"cav{i}" for i in range(VEHICLES)} - {f"cav{liar}"}
    assert not [entry for entry in book.entries if entry.client == f"cav{liar}" and entry.bytes > 10**6]


def test_a_budget_that_affords_no_answer_ends_the_federation_and_one_that_affords_some_is_enforced(folder: Path):
    with pytest.raises(
        BudgetExceeded, match=r"cav0: an answer of more than the 5000 bytes that are left on the wireless"
    ):
        run(folder, {}, megabytes=0.005)
    with pytest.raises(BudgetExceeded, match="wireless uplink budget exceeded"):
        run(folder, {}, megabytes=0.015)


def test_a_vehicle_alone_ends_nothing_by_a_claim_either(folder: Path):
    """Where the others are lost, nothing that came tells how large an answer is: only what it can be at most."""
    others = dict.fromkeys(range(FIRST + 1, FIRST + VEHICLES), with_code(2))
    with pytest.raises(ClientFailed, match=r"cav0: no answer, as if \d+ bytes were too few for it"):
        run(folder, {FIRST: with_code(OVER_BUDGET), **others})


def test_a_vehicle_s_word_that_the_network_lost_it_does_not_excuse_it(folder: Path):
    """Two of three that were lost would leave a round of one; two that fail are too many."""
    lies: dict[int, Lie] = dict.fromkeys((FIRST, FIRST + 1), with_code(LOST_BY_NETWORK))
    with pytest.raises(ClientFailed, match="1 of 3 clients sent an update that can be used, 2 are wanted"):
        run(folder, lies)


def test_a_vehicle_that_claims_does_not_end_questions(folder: Path):
    clients, account = (
        {f"cav{i}": Vehicle() for i in range(2)},
        Account(Ledger(LinkMegabytes(9, 0)), "edge", "t", "wireless"),
    )
    for lies in ({FIRST: with_code(OVER_BUDGET)}, {FIRST: with_code(LOST_BY_NETWORK)}):
        with open_link(clients, Fleet(folder, lies), account, ClientAgreement(FEDAVG, Rules(), {}, 0), {}) as link:  # type: ignore[arg-type]
            for asked in (["cav0", "cav1"], ["cav0"]):
                told = link.ask("offer", asked)
                assert told.missing.keys() == {"cav0"}
                assert [*told.answers] == asked[1:]


def test_an_answer_of_any_rule_is_within_what_is_granted(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """With most vehicles' worth of answers in one, of the kinds that are largest beside what was asked."""
    granted: list[tuple[int, int]] = []
    call = VehicleApp.__call__

    def listening(self: VehicleApp, message: Message, context: Context) -> Message:
        limit = int(message.content.config_records["grant"]["bytes"]) if "grant" in message.content else 2**62  # type: ignore[arg-type]
        answer = call(self, message, context)
        granted.append((limit, wire_bytes(answer.content)))
        return answer

    monkeypatch.setattr(VehicleApp, "__call__", listening)
    for rules in RULES:
        state, _ = run(folder, {}, rules, megabytes=10**6, rounds=1)
        assert not state.records[0].failed
    assert all(size < limit for limit, size in granted)
    assert min(limit for limit, _ in granted) < 10**5


@pytest.mark.parametrize("count", [3, 400])
def test_shares_for_every_client_are_within_the_largest_answer(folder: Path, count: int):
    names, link = {node: f"grid/cav{node}" for node in range(count)}, Apps(folder, {})
    account: Any = None
    with keep_identity():
        grid = DeployedGrid(folder, link, names, {}, account)  # type: ignore[arg-type]
    shares = ConfigRecord({NAMES: [*names.values()], SHARES: [bytes(SEALED_BYTES)] * count})
    assert wire_bytes(RecordDict({ASK: shares})) < grid._most_bytes


def of_keys(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Lie:
    """Return a lie in the place of the keys of a client under masks."""

    def lie(asked: Message, answer: Message) -> Message:
        if ASK not in asked.content or asked.content.config_records[ASK][ASK] != "keys":
            return answer
        record = ConfigRecord(change(dict(answer.content.config_records[ASK])))
        return Message(RecordDict({ASK: record}), reply_to=asked)

    return lie


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda own: {kind: own[kind] for kind in ("ciphers", "masks")}, "a certificate or a signature is missing"),
        (lambda own: {**own, "signatures": bytes(96)}, "no certified vehicle has signed"),
        (lambda own: {**own, "signatures": b""}, "a certificate or a signature is missing"),
        (lambda own: {**own, "certificates": own["certificates"][:-1]}, "no certified vehicle has signed"),
        (lambda own: {**own, "certificates": [b"a", b"b"]}, "a certificate or a signature that is not in bytes"),
        (lambda own: {**own, "masks": draw_keys()[1]}, "another signature"),
    ],
)
def test_keys_that_no_certified_vehicle_has_signed_cost_their_client_the_round(folder: Path, change: Any, told: str):
    """The other vehicles would refuse to take part with it."""
    state, _ = run(folder, {FIRST + 1: of_keys(change)}, "masks")
    assert all(record.failed.keys() == {"cav1"} and told in record.failed["cav1"] for record in state.records)
    assert all(record.clients == ("cav0", "cav2") for record in state.records)


def test_a_vehicle_that_stands_for_two_clients_counts_once(folder: Path):
    identity, kept = load_identity(folder / f"v{FIRST}"), PublicKeys(*(draw_keys()[1] for _ in range(2)))

    def pose(own: dict[str, Any]) -> dict[str, Any]:
        certificate, signature = identity.sign("cav1", 1, kept)
        return {"ciphers": kept.cipher, "masks": kept.mask, "certificates": certificate, "signatures": signature}

    state, _ = run(folder, {FIRST + 1: of_keys(pose)}, "masks", rounds=1)
    assert state.records[0].failed == {"cav1": "keys of the vehicle of cav0"}
