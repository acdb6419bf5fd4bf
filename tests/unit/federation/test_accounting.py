"""Epsilon that is reported, against an accountant of others on what clients have sent.

Each client's exposures are the different changes that left it, as they were before masks. The accountant composes
privacy loss distributions (`dp_accounting.pld`), where ours composes Renyi divergences: what is reported is not below
it, and above by no more than the factors of `ABOVE`.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from dp_accounting import DpEvent, GaussianDpEvent, PoissonSampledDpEvent
from dp_accounting.pld import PLDAccountant
from flwr.app import Context, Message

from flcav.federation import client
from flcav.federation.conduct import ANSWERED
from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import Schedule, federate
from flcav.federation.modes.buffered import Buffers, fill_in_turns
from flcav.federation.rules import Rules
from flcav.federation.secure.parties import SecureClient
from flcav.federation.state import FederationState
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import LocalUpdate, Update, Weights
from flcav.federation.wire import VECTOR, read_arrays
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.runs.training.private_rounds import PrivateTraining, compose_trainings

ABOVE = {"gaussian": 1.25, "poisson": 1.4, "uniform": 2.0}  # factors, by what amplifies
DELTA, NOISE, CLIENTS = 1e-5, 2.0, 5
START = {"w": np.zeros(8, np.float32)}
SCHEDULE = Schedule(7, 1, 0.1, 0.1, 3)
LOCAL: dict[str, Any] = {"privacy": {"where": "local", "noise": NOISE}}
CENTRAL: dict[str, Any] = {"privacy": {"noise": NOISE}}
TURNS, POISSON = {"rule": "round-robin", "clients": 2}, {"rule": "poisson", "probability": 0.4}
UNIFORM = {"rule": "uniform", "clients": 2}
DEADLINE = {"rule": "deadline", "deadline_s": 2.5, "seconds": {f"cav{i}": float(i) for i in range(CLIENTS)}}
Exposures = dict[int, set[bytes]]  # by node, the changes that left it


class Walker:
    def train(self, weights: Weights, *, seed: int, **_: Any) -> LocalUpdate:
        step = np.random.default_rng(seed).normal(size=8)
        return LocalUpdate({"w": (weights["w"] + step).astype(np.float32)}, 3, 0.5)


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Exposures:
    """Note what leaves each client; of masked updates what the masks hide."""
    found: Exposures = defaultdict(set)
    reply, mask = client.wire.reply, client.mask_update

    def noted(message: Message, update: Update, extra: Weights) -> Message:
        if VECTOR not in update.weights:
            found[message.metadata.dst_node_id].add(np.asarray(update.weights["w"]).tobytes())
        return reply(message, update, extra)

    def hidden(context: Context, integers: Any) -> Any:
        found[context.node_id].add(read_arrays(context.state, client.HIDDEN)[VECTOR].tobytes())
        return mask(context, integers)

    monkeypatch.setattr(client.wire, "reply", noted)
    monkeypatch.setattr(client, "mask_update", hidden)
    return found


def run(rules: dict[str, Any], state: FederationState, rounds: int = SCHEDULE.rounds, **how: Any) -> Weights:
    account = Account(Ledger(LinkMegabytes(99, 0)), "edge", "walk", "wireless", how.pop("outages", {}))
    clients, schedule = {f"cav{i}": Walker() for i in range(CLIENTS)}, replace(SCHEDULE, rounds=rounds)
    start = how.pop("start", START)
    found = federate(
        cast(Any, clients), start, schedule, account, rules=Rules.model_validate(rules), state=state, **how
    )
    return found.weights


def epsilon_of(events: Iterable[tuple[DpEvent, int]]) -> float:
    accountant = PLDAccountant(value_discretization_interval=1e-3)
    for event, number in events:
        accountant.compose(event, number)
    return accountant.get_epsilon(DELTA)


def most(sent: Exposures) -> int:
    return max(len(each) for each in sent.values())


def check(reported: float | None, events: Iterable[tuple[DpEvent, int]], kind: str = "gaussian") -> None:
    assert reported is not None
    expected = epsilon_of(events)
    assert expected * 0.999 <= reported <= ABOVE[kind] * expected, (reported, expected)


def gaussian(sent: Exposures, local: bool = False) -> list[tuple[DpEvent, int]]:
    """Return the events of the client that sent most: local noise is between any two of its changes, 2 `clip` apart."""
    return [(GaussianDpEvent(NOISE / 2 if local else NOISE), most(sent))]


def last(state: FederationState) -> float | None:
    return state.records[-1].epsilon


@pytest.mark.parametrize(
    ("rules", "exposures"),
    [
        (CENTRAL, 7),
        ({**CENTRAL, "selection": TURNS}, 3),
        (
            {
                **CENTRAL,
                "selection": {"rule": "deadline", "deadline_s": 1, "seconds": {f"cav{i}": i for i in range(5)}},
            },
            7,
        ),
        (LOCAL, 7),
        ({**LOCAL, "selection": TURNS}, 3),
        ({**LOCAL, "upload": {"compression": "int8"}}, 7),
        ({**LOCAL, "secure": {}}, 7),
        ({**LOCAL, "secure": {}, "selection": {"rule": "round-robin", "clients": 3}}, 5),
    ],
)
def test_full_participation_and_turns(sent: Exposures, rules: dict[str, Any], exposures: int):
    state = FederationState()
    run(rules, state)
    assert most(sent) == exposures
    check(last(state), gaussian(sent, rules["privacy"].get("where") == "local"))
    for name, kept in state.clients.items():  # a client's own count, by which it holds the server to its budget
        answered = int(kept[ANSWERED][ANSWERED][2])
        assert answered == len(sent[2 + int(name[3:])])


@pytest.mark.parametrize(("selection", "kind"), [(POISSON, "poisson"), (UNIFORM, "uniform")])
def test_secret_draws(sent: Exposures, selection: dict[str, Any], kind: str):
    """A client that sent its change in each round that drew it; of a fixed number one is replaced, 2 `clip` apart."""
    state = FederationState()
    run({**CENTRAL, "selection": selection}, state)
    assert sum(map(len, sent.values())) < 7 * CLIENTS
    noise = NOISE if kind == "poisson" else NOISE / 2
    check(last(state), [(PoissonSampledDpEvent(0.4, GaussianDpEvent(noise)), 7)], kind)
    sent.clear()
    drawn = FederationState()
    run({**LOCAL, "selection": selection}, drawn)  # no draw amplifies noise that each update has of its own
    assert cast(float, last(drawn)) >= 0.999 * epsilon_of(gaussian(sent, local=True))
    check(last(drawn), [(GaussianDpEvent(NOISE / 2), 7)])


@pytest.mark.parametrize("rules", [LOCAL, CENTRAL])
def test_buffers(sent: Exposures, rules: dict[str, Any]):
    state, local = FederationState(), rules is LOCAL
    run(rules, state, strategy=FedBuff(2))
    check(last(state), gaussian(sent, local))
    before = Buffers(fill_in_turns([*map("cav{}".format, range(CLIENTS))], 2, 7).rounds, {"cav0": 4, "cav4": 5})
    late = FederationState()
    run(rules, late, strategy=FedBuff(2), buffers=before)
    noise = NOISE / 2 if local else NOISE
    times = max(len(sent[2 + i]) // 2 + number for i, number in enumerate((4, 0, 0, 0, 5)))  # each run sent as much
    check(last(late), [(GaussianDpEvent(noise), times)])


@pytest.mark.parametrize("rules", [LOCAL, {**LOCAL, "secure": {}}, CENTRAL, {**CENTRAL, "selection": TURNS}])
def test_a_run_that_is_stopped_and_resumed_sends_nothing_twice_with_other_noise(
    sent: Exposures, rules: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    """It ends in the middle of the fourth round, which is repeated from the checkpoint of the third."""
    kept, state, local = list[Any](), FederationState(), rules["privacy"].get("where") == "local"

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        kept.append((weights, state.to_arrays(), [*state.records]))

    train, trained = Walker.train, list[int]()

    def stopping(self: Walker, weights: Weights, *, seed: int, **how: Any) -> LocalUpdate:
        trained.append(seed)
        if len(kept) == 3 and len(trained) == total + 2:
            raise KeyboardInterrupt
        return train(self, weights, seed=seed)

    total = 3 * (2 if "selection" in rules else CLIENTS)
    monkeypatch.setattr(Walker, "train", stopping)
    with pytest.raises(KeyboardInterrupt):
        run(rules, state, on_round=keep)
    again = FederationState(secrets=state.secrets)
    again.restore(kept[2][1], kept[2][2])
    run(rules, again, start=kept[2][0], done=3)
    assert len(trained) > total + 2
    assert most(sent) == (3 if "selection" in rules else 7)
    check(last(again), gaussian(sent, local))


def test_rounds_of_masks_that_begin_anew(sent: Exposures, monkeypatch: pytest.MonkeyPatch):
    """One client's shares do not open for another: after both are out, the others mask the update that they have."""
    share, tried = SecureClient.share, list[str]()

    def lying(self: SecureClient, *about: Any) -> dict[str, bytes]:
        found = share(self, *about)
        tried.append(self.name)
        return {**found, "cav1": bytes(len(found["cav1"]))} if self.name == "cav0" and "cav1" in found else found

    monkeypatch.setattr(SecureClient, "share", lying)
    state = FederationState()
    run({**LOCAL, "secure": {}}, state)
    assert all(record.failed.keys() == {"cav0", "cav1"} for record in state.records)
    assert tried.count("cav2") == 2 * 7  # each round was begun twice
    assert most(sent) == 7
    check(last(state), gaussian(sent, local=True))


def test_two_tasks_and_two_stages_with_the_same_vehicles(sent: Exposures):
    """Stage III goes on counting where stage II ended; another task has noise of its own."""
    for local, selection in ((True, {}), (False, {}), (False, TURNS)):
        sent.clear()
        rules = {**(LOCAL if local else CENTRAL), "selection": selection} if selection else LOCAL if local else CENTRAL
        state, other = FederationState(), FederationState()
        weights = run(rules, state)
        run(rules, state, rounds=4, start={"w": weights["w"] + 1}, earlier=7) if not local else None
        first = most(sent)
        check(last(state), gaussian(sent, local))
        sent.clear()
        more = {**rules, "privacy": {**rules["privacy"], "noise": 3.0}}
        run(more, other, rounds=5)
        both = [PrivateTraining("ring", CLIENTS, 7 if local else 11, NOISE), PrivateTraining("ring", CLIENTS, 5, 3.0)]
        spent = compose_trainings(Rules.model_validate(rules), both)
        scale = 0.5 if local else 1.0
        events = [(GaussianDpEvent(NOISE * scale), first), (GaussianDpEvent(3.0 * scale), most(sent))]
        assert spent is not None
        check(spent.epsilon, events)


def test_vehicles_that_come_late(sent: Exposures):
    """The account is of whoever was there all along; who comes late has sent less."""
    absent = {(number, name): Outage("not in the town") for number in (1, 2, 3) for name in ("cav3", "cav4")}
    for rules in (LOCAL, CENTRAL):
        sent.clear()
        state = FederationState()
        run(rules, state, outages=absent)
        assert [len(sent[node]) for node in range(2, 7)] == [7, 7, 7, 4, 4]
        check(last(state), gaussian(sent, rules is LOCAL))


@pytest.mark.parametrize("rules", [LOCAL, CENTRAL, {**CENTRAL, "selection": TURNS}, {**LOCAL, "secure": {}}])
def test_what_clients_sent_within_a_budget_is_within_it_by_the_other_accountant_too(
    sent: Exposures, rules: dict[str, Any]
):
    state, budget = FederationState(), 6.0
    local = rules["privacy"].get("where") == "local"
    run({**rules, "privacy": {**rules["privacy"], "epsilon": budget}}, state, rounds=40)
    assert epsilon_of(gaussian(sent, local)) <= cast(float, last(state)) <= budget
    (noise, times), *_ = gaussian(sent, local)
    assert epsilon_of([(noise, 2 * times + 2)]) > budget
