"""Buffered rounds: FedAvg where nobody is stale, a schedule by hand, budgets, epsilon, resuming, and stage III."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from regression import START, Regression, ledger, vehicles

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.in_process import update_bytes
from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.modes.buffered import BrokenUpdate, Buffers, FilledBuffer, fill_in_turns
from flcav.federation.privacy import Privacy, account_epsilon
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.state import UNSENT, FederationState
from flcav.federation.strategies import of_servers, strategy_named
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Ledger
from flcav.statistics.streams import derive_seed

SCHEDULE = Schedule(4, 3, 0.1, 0.02, 5)


def account(book: Ledger | None = None, stage: str = "edge") -> Account:
    return Account(book or ledger(), stage, "line", "wireless")


def same(one: Weights, other: Weights) -> bool:
    return {*one} == {*other} and all(np.array_equal(one[name], other[name]) for name in one)


class Adds:
    """Adds its number to the weight, so that staleness is seen at a glance."""

    def __init__(self, number: float, samples: int) -> None:
        self.number, self.samples, self.begun = number, samples, list[float]()

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        self.begun.append(float(weights["w"][0]))
        moved = {"w": weights["w"] + self.number, "bn.running_var": np.full(1, self.number)}
        return LocalUpdate(moved, self.samples, 0.0)


def test_a_buffer_of_all_gives_the_weights_of_federated_averaging_to_the_bit():
    clients, books = vehicles("grid", 4), (ledger(), ledger())
    plain = federate(clients, START, SCHEDULE, account(books[0]))
    found = federate(clients, START, SCHEDULE, account(books[1]), strategy=FedBuff(buffer=4))
    assert same(found.weights, plain.weights)
    assert (found.samples, found.loss) == (plain.samples, plain.loss)
    assert books[0].entries == books[1].entries


def test_a_schedule_by_hand():
    """a and b fill the first buffer, c (of the first weights) and a the second, b and c the third.

    1: 0 + (1 1 + 3 2) / 4 = 1.75. 2: c began with 0, two versions of the weights ago but one: its change 4 counts
    by 1/sqrt 2, a's 1 counts whole: 1.75 + (2 4/sqrt 2 + 1 1) / 3. 3: b began with version 1, c with version 2.
    """
    clients = {"a": Adds(1.0, 1), "b": Adds(2.0, 3), "c": Adds(4.0, 2)}
    rounds = ({"a": 0, "b": 0}, {"c": 0, "a": 1}, {"b": 1, "c": 2})
    reached: list[float] = []
    federate(
        clients,
        {"w": np.zeros(1), "bn.running_var": np.ones(1)},
        replace(SCHEDULE, rounds=3),
        strategy=FedBuff(),
        buffers=Buffers(tuple(FilledBuffer(each) for each in rounds)),
        on_round=lambda number, weights, loss: reached.append(float(weights["w"][0])),
    )
    half = 2**-0.5
    first = 1.75
    second = first + (2 * 4 * half + 1 * 1) / 3
    third = second + (3 * 2 * half + 2 * 4) / 5
    assert reached == pytest.approx([first, second, third], rel=1e-15)
    assert clients["c"].begun == [0.0, reached[1]]
    assert (clients["a"].begun, clients["b"].begun) == ([0.0, first], [0.0, first])


def test_statistics_stay_between_those_of_server_and_client():
    start, begun = {"w": np.array([5.0]), "bn.running_var": np.array([1.0])}, {"w": np.array([3.0])}
    update = LocalUpdate({"w": np.array([4.0]), "bn.running_var": np.array([0.2])}, 7, 1.5)
    found = FedBuff(exponent=1.0).rebase(start, begun | {"bn.running_var": np.array([9.0])}, update, 3)
    assert (found.weights["w"], found.weights["bn.running_var"]) == (5.25, pytest.approx(0.8))
    assert (found.samples, found.loss) == (7, 1.5)
    assert FedBuff().rebase(start, begun, update, 0) is update


def test_the_server_rate_scales_the_step():
    start = {"w": np.zeros(2, np.float32)}
    updates = [LocalUpdate({"w": np.full(2, each, np.float32)}, 1, 0.0) for each in (1.0, 3.0)]
    assert FedBuff(rate=0.5).combine(start, updates)["w"].tolist() == [1.0, 1.0]


def test_clients_train_with_the_seed_and_rate_of_the_version_that_they_were_sent():
    asked = []

    class Notes:
        def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
            asked.append((learning_rate, seed))
            return LocalUpdate(weights, 1, 0.0)

    buffers = Buffers((FilledBuffer({"a": 0}), FilledBuffer({"a": 1}), FilledBuffer({"b": 0})))
    federate({"a": Notes(), "b": Notes()}, START, SCHEDULE, strategy=FedBuff(1), buffers=buffers)
    work = [SCHEDULE.work(version + 1) for version in (0, 1, 0)]
    names = ("a", "a", "b")
    assert asked == [(w.learning_rate, derive_seed(w.seed, name)) for w, name in zip(work, names, strict=True)]


@pytest.mark.parametrize("processes", [1, 2])
def test_resumed_it_ends_with_the_same_bytes(processes: int):
    clients = vehicles("grid", 5)
    kept: list[tuple[Weights, dict, list]] = []
    state = FederationState()

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        kept.append((weights, state.to_arrays(), [*state.records]))

    whole, book = federate(clients, START, SCHEDULE, strategy=FedBuff(2), state=state, on_round=keep), ledger()
    weights, arrays, records = kept[1]
    again = FederationState()
    again.restore(arrays, records)
    with ClientProcesses(clients, processes) as where:
        how: Any = {"runtime": where if processes > 1 else None, "done": 2}
        found = federate(clients, weights, SCHEDULE, account(book), strategy=FedBuff(2), state=again, **how)
    assert same(found.weights, whole.weights)
    assert again.records == state.records
    assert {int(key.split("|")[1]) for key in arrays if key.startswith("server|")} <= {0, 1}


def test_an_update_over_the_budget_is_not_sent_and_ends_the_federation():
    clients, size = vehicles("grid", 3), update_bytes(START)
    book, state, rounds = ledger(wireless_mb=3.5 * size / 1e6), FederationState(), []
    how: Any = {"strategy": FedBuff(2), "state": state}
    found = federate(clients, START, SCHEDULE, account(book), **how, on_round=lambda n, *_: rounds.append(n))
    ups = [entry for entry in book.entries if entry.direction == "up"]
    assert len(ups) == 3
    assert book.left_mb("wireless") >= 0
    assert rounds == [1, 2]
    assert [len(record.clients) for record in state.records] == [2, 1]
    (late,) = state.records[-1].failed.items()
    assert late[1] == UNSENT
    assert late[0] not in {entry.client for entry in ups if entry.round == 2}
    before = book.entries
    assert same(federate(clients, found.weights, SCHEDULE, account(book), **how, done=2).weights, found.weights)
    assert book.entries == before


def test_what_breaks_off_is_in_the_ledger_and_named():
    clients, book, state = vehicles("grid", 3), ledger(), FederationState()
    broken = (BrokenUpdate("grid/cav2", "left the town", 100, 40), BrokenUpdate("grid/cav0", "out of coverage", 7, 0))
    buffers = Buffers((FilledBuffer({"grid/cav0": 0, "grid/cav1": 0}, broken),))
    one = replace(SCHEDULE, rounds=1)
    federate(clients, START, one, account(book), strategy=FedBuff(2), state=state, buffers=buffers)
    sizes = {(entry.client, entry.direction): entry.bytes for entry in book.entries[:4]}
    assert sizes[("grid/cav2", "down")] == 100
    assert sizes[("grid/cav2", "up")] == 40
    assert state.records[0].failed == {"grid/cav2": "left the town"}
    assert state.records[0].clients == ("grid/cav0", "grid/cav1")


@pytest.mark.parametrize("where", ["local", "central"])
def test_epsilon_is_that_of_the_client_that_took_part_most_often(where: Any):
    """cav0 takes part in three of four rounds, and began a fourth time to send what broke off."""
    rounds = [{"grid/cav0": 0, "grid/cav1": 0}, {"grid/cav0": 1, "grid/cav2": 0}, {"grid/cav0": 2, "grid/cav1": 1}]
    last = FilledBuffer({"grid/cav1": 3, "grid/cav2": 2}, (BrokenUpdate("grid/cav0", "left the town", 9, 9),))
    buffers = Buffers((*(FilledBuffer(each) for each in rounds), last))
    privacy, state = Privacy(where=where, clip=0.1, noise=2.0, seeded=True), FederationState()
    how: Any = {"strategy": FedBuff(2), "state": state, "buffers": buffers}
    federate(vehicles("grid", 3), START, SCHEDULE, rules=Rules(privacy=privacy), **how)
    told = [account_epsilon(privacy, Selection(), ["one"], times) for times in (1, 2, 3, 4)]
    assert [record.epsilon for record in state.records] == told
    more = replace(buffers, before={"grid/cav1": 3})
    assert more.epsilon(privacy, 4) == account_epsilon(privacy, Selection(), ["one"], 6)


def test_a_privacy_budget_ends_it_before_it_is_exceeded():
    privacy, state = Privacy(where="local", clip=0.1, noise=2.0, seeded=True), FederationState()
    within = account_epsilon(privacy, Selection(), ["one"], 2)
    bounded = privacy.model_copy(update={"epsilon": within * 1.001})
    how: Any = {"strategy": FedBuff(2), "state": state}
    federate(vehicles("grid", 4), START, replace(SCHEDULE, rounds=8), rules=Rules(privacy=bounded), **how)
    assert len(state.records) == 4  # of four clients in turn each takes part twice
    tiny = privacy.model_copy(update={"epsilon": 1e-3})
    with pytest.raises(InputError, match="a first buffer comes to epsilon"):
        federate(vehicles("grid", 4), START, SCHEDULE, rules=Rules(privacy=tiny), strategy=FedBuff(2))


def test_a_client_that_fails_is_named_and_its_buffer_goes_on():
    clients, state = vehicles("grid", 3), FederationState()
    clients["grid/cav1"] = Regression(np.ones((1, 3)), np.ones(1), fail=True)
    federate(clients, START, SCHEDULE, strategy=FedBuff(2), state=state)
    assert [sorted(record.failed) for record in state.records] == [["grid/cav1"], [], ["grid/cav1"], ["grid/cav1"]]


def test_edge_servers_are_asynchronous_below_a_synchronous_cloud():
    """Buffers of all below are stage III of federated averaging; in smaller ones vehicles go on over cloud rounds."""
    found = []
    for strategy in (FedAvg(), FedBuff(3), FedBuff(2)):
        book = ledger()
        servers = {
            region: EdgeServer(
                vehicles(region, 3), 2, account(book, "cloud"), START, strategy=strategy, state=FederationState()
            )
            for region in ("grid", "ring")
        }
        line = Account(book, "cloud", "line", "wireline")
        found.append(federate(servers, START, SCHEDULE, line, strategy=of_servers(strategy)).weights)
        assert [record.round for record in servers["grid"].state.records] == [*range(1, 9)]
    assert same(found[0], found[1])
    assert not same(found[0], found[2])
    assert of_servers(FedBuff()) == FedAvg()


def test_turns_of_equal_clients():
    """All are ready at once: c waits in the second buffer, where a, which has begun again, joins it."""
    assert [dict(each.versions) for each in fill_in_turns(["a", "b", "c"], 2, 3).rounds[:3]] == [
        {"a": 0, "b": 0},
        {"c": 0, "a": 1},
        {"b": 1, "c": 2},
    ]


@pytest.mark.parametrize(
    ("rules", "told"),
    [
        ({"selection": {"rule": "uniform", "clients": 2}}, "uniform selects some"),
        ({"secure": {}}, "masks cancel"),
        ({"least_clients": 3}, "least_clients 3, and a buffer has 2"),
        ({"personal": {"pull": 0.1}}, "regional models"),
        ({"privacy": {"epsilon": 8}}, "give 'privacy.noise'"),
    ],
)
def test_rules_that_do_not_go_with_it_are_refused(rules: dict[str, Any], told: str):
    with pytest.raises(InputError, match=told):
        federate(vehicles("grid", 3), START, SCHEDULE, rules=Rules.model_validate(rules), strategy=FedBuff(2))


def test_settings_by_name():
    assert strategy_named({"fedbuff": {"buffer": 3, "exponent": 0.0}}) == FedBuff(3, 0.0)
    with pytest.raises(InputError, match="buffer = 0"):
        strategy_named({"fedbuff": {"buffer": 0}})
    with pytest.raises(InputError, match="a buffer of 4 updates, no two of one client, and 3 clients"):
        federate(vehicles("grid", 3), START, SCHEDULE, strategy=FedBuff(4))
