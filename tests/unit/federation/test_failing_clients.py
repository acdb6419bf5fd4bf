"""Clients that fail in a round: how many may, who is named, and what says that too few are left."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from regression import START, Regression, ledger, vehicles

from flcav.config import InputError
from flcav.federation.attendance import ClientFailed
from flcav.federation.edge_server import EdgeServer
from flcav.federation.rounds import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.metered import Account
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.krum import Krum
from flcav.federation.strategies.median import Median
from flcav.federation.trainable import LocalUpdate, Trainable
from flcav.network.ledger import BudgetExceeded

SCHEDULE = Schedule(rounds=2, steps=5, learning_rate=0.05, final_learning_rate=0.01, seed=3)


def edge() -> Account:
    return Account(ledger(), "edge", "regression", "wireless")


def failing(number: int, fail: int) -> dict[str, Regression]:
    clients = vehicles("grid", number)
    for each in [*clients.values()][:fail]:
        each.fail = True
    return clients


@pytest.mark.parametrize(("number", "fail"), [(4, 2), (5, 2), (2, 1)])
def test_by_default_a_round_goes_on_with_half_of_the_clients_and_names_the_others(number: int, fail: int):
    clients, state = failing(number, fail), FederationState()
    found = federate(clients, START, SCHEDULE, edge(), state=state)
    usable = {name: client for name, client in clients.items() if not client.fail}
    assert [record.clients for record in state.records] == [tuple(usable)] * SCHEDULE.rounds
    assert all(record.failed.keys() == clients.keys() - usable.keys() for record in state.records)
    assert all("no power" in reason for record in state.records for reason in record.failed.values())
    np.testing.assert_array_equal(found.weights["w"], federate(usable, START, SCHEDULE, edge()).weights["w"])


@pytest.mark.parametrize(
    ("number", "fail", "least", "wanted"),
    [(4, 3, None, 2), (5, 3, None, 3), (1, 1, None, 1), (4, 1, "all", 4), (4, 2, 3, 3), (4, 4, 1, 1)],
)
def test_fewer_clients_than_are_wanted_end_the_federation_with_their_reasons(
    number: int, fail: int, least: Any, wanted: int
):
    told = f"round 1: {number - fail} of {number} clients sent an update that can be used, {wanted} are wanted"
    with pytest.raises(ClientFailed, match=rf"{told} \(grid/cav0: .*no power"):
        federate(failing(number, fail), START, SCHEDULE, edge(), rules=Rules(least_clients=least))


def test_half_of_all_have_to_tell_their_samples_and_half_of_those_drawn_have_to_send():
    class Miscounting(Regression):
        def count_samples(self, steps: int) -> int:
            raise OSError("no memory")

    def run(clients: Mapping[str, Trainable], rule: str, least: Any = None) -> FederationState:
        state, selection = FederationState(), Selection.model_validate({"rule": rule, "clients": 2, **extra[rule]})
        rules = Rules(selection=selection, least_clients=least)
        federate(clients, START, replace(SCHEDULE, rounds=1), edge(), rules=rules, state=state)
        return state

    extra: dict[str, dict[str, bool]] = {"uniform": {"unbiased": True}, "importance": {}}
    deaf = {
        name: Miscounting(each.inputs, each.targets) if i < 3 else each
        for i, (name, each) in enumerate(vehicles("grid", 5).items())
    }
    with pytest.raises(ClientFailed, match=r"2 of 5 clients .*, 3 are wanted .*no memory"):
        run(deaf, "uniform")
    assert run(failing(5, 2), "importance").records[0].failed.keys() == {"grid/cav0", "grid/cav1"}
    with pytest.raises(ClientFailed, match=r"2 of 5 clients .*, 3 are wanted .*no power"):
        run(failing(5, 3), "importance")
    for clients, rule, left in ((deaf, "uniform", 2), (failing(5, 3), "importance", 2)):
        with pytest.raises(ClientFailed, match=f"{left} of 5 clients .*, 5 are wanted"):
            run(clients, rule, "all")
    assert len(run(failing(5, 3), "importance", 1).records[0].failed) == 3  # of those who were to report
    with pytest.raises(ClientFailed, match=r"0 of 2 clients .*, 1 are wanted .*no memory"):  # cav1 and cav2 are drawn
        run(deaf, "uniform", 1)
    record = run(deaf | {"grid/cav2": vehicles("grid", 5)["grid/cav2"]}, "uniform", 1).records[0]
    assert (record.clients, {*record.failed}) == (("grid/cav2",), {"grid/cav0", "grid/cav1"})


def test_a_client_s_word_that_a_budget_is_exceeded_ends_nothing_and_an_edge_server_s_does():
    class Claiming(Regression):
        def train(self, weights: Any, **how: Any) -> LocalUpdate:
            raise BudgetExceeded("wireless uplink budget exceeded")

    clients, state = vehicles("grid", 3), FederationState()
    first = clients["grid/cav0"]
    given = {**clients, "grid/cav0": Claiming(first.inputs, first.targets)}
    for rules in (Rules(), Rules.model_validate({"secure": {}})):
        federate(given, START, SCHEDULE, edge(), rules=rules, state=state)
        assert all(record.failed.keys() == {"grid/cav0"} for record in state.records)
        assert "wireless uplink budget exceeded" in state.records[0].failed["grid/cav0"]
        state.records.clear()
    account = Account(ledger(wireless_mb=1e-4), "cloud", "regression", "wireless")
    server = EdgeServer(clients, 1, account, START)
    with pytest.raises(BudgetExceeded, match="wireless uplink budget exceeded"):
        federate({"grid": server}, START, SCHEDULE, edge())


@pytest.mark.parametrize("least", [None, 1, "all"])
@pytest.mark.parametrize(
    "selection",
    [
        {"rule": "uniform", "clients": 2, "unbiased": True},
        {"rule": "poisson", "probability": 0.9, "unbiased": True},
        {"rule": "importance", "clients": 2},
    ],
    ids=["uniform", "poisson", "importance"],
)
def test_a_round_in_which_no_client_reports_is_no_chance_and_ends_the_federation(selection: dict[str, Any], least: Any):
    class Broken(Regression):
        def count_samples(self, steps: int) -> int:
            raise OSError("no power")

    clients = {name: Broken(each.inputs, each.targets, fail=True) for name, each in vehicles("grid", 6).items()}
    rules, state = Rules.model_validate({"selection": selection, "least_clients": least}), FederationState()
    with pytest.raises(ClientFailed, match=r"^round 1: .* wanted.*\(grid/cav0: .*no power"):
        federate(clients, START, SCHEDULE, edge(), rules=rules, state=state)
    assert not state.records


@pytest.mark.parametrize("samples", [0, -1, 2.5, 10**30, np.nan, np.inf])
@pytest.mark.parametrize(
    "rules",
    [
        {},
        {"secure": {}},
        {"selection": {"rule": "uniform", "clients": 5, "unbiased": True}},
        {"selection": {"rule": "importance", "clients": 5}},
    ],
    ids=["open", "secure", "unbiased", "importance"],
)
def test_a_client_of_no_number_of_samples_is_named_and_the_others_go_on(samples: Any, rules: dict[str, Any]):
    class Odd(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            return replace(super().train(*weights, **how), samples=samples)

        def count_samples(self, steps: int) -> int:
            return samples

    honest, state = vehicles("grid", 5), FederationState()
    odd = Odd(honest["grid/cav1"].inputs, honest["grid/cav1"].targets)
    how = {"rules": Rules.model_validate(rules), "strategy": FEDAVG if rules else Krum(byzantine=0)}
    federate(honest | {"grid/cav1": odd}, START, SCHEDULE, edge(), state=state, **how)
    for record in state.records:
        assert record.failed.keys() == {"grid/cav1"}
        assert "samples" in record.failed["grid/cav1"]


def test_samples_and_loss_may_be_numbers_of_numpy():
    class Scalars(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            found = super().train(*weights, **how)
            return replace(found, samples=np.int64(found.samples), loss=np.float32(0.5))

        def count_samples(self, steps: int) -> int:
            return np.int64(3)  # type: ignore[return-value]

    clients = {name: Scalars(each.inputs, each.targets) for name, each in vehicles("grid", 3).items()}
    for selection in ({"rule": "importance", "clients": 3}, {"rule": "uniform", "clients": 3, "unbiased": True}):
        state = FederationState()
        rules = Rules.model_validate({"selection": selection})
        federate(clients, START, SCHEDULE, edge(), rules=rules, state=state)
        assert [(record.failed, record.loss) for record in state.records] == [({}, 0.5)] * SCHEDULE.rounds


def test_one_client_that_fails_to_report_does_not_pass_for_a_small_draw():
    rules = Rules.model_validate({"selection": {"rule": "importance", "clients": 1}, "least_clients": 5})
    with pytest.raises(ClientFailed, match=r"^round 1: least_clients: 5 are wanted .*\(grid/cav0: .*no power"):
        federate(failing(6, 1), START, SCHEDULE, edge(), rules=rules)
    state = FederationState()
    federate(failing(6, 0), START, SCHEDULE, edge(), rules=rules, state=state)
    assert [record.clients for record in state.records] == [(), ()]


@pytest.mark.parametrize(
    "selection",
    [{"rule": "poisson", "probability": 0.9}, {"rule": "importance", "clients": 3}, {"rule": "planned"}],
    ids=["poisson", "importance", "planned"],
)
def test_more_clients_than_there_are_cannot_be_wanted(selection: dict[str, Any]):
    def run(least: int) -> None:
        rules = Rules.model_validate({"selection": selection, "least_clients": least})
        federate(vehicles("grid", 6), START, SCHEDULE, edge(), rules=rules)

    run(6)
    with pytest.raises(InputError, match="least_clients: 7 are wanted in a round, and 6 take part"):
        run(7)


@pytest.mark.parametrize(
    ("strategy", "told"),
    [(Krum(byzantine=1), "krum: 5 clients or more are wanted .* there are 4"), (Median(), None)],
    ids=["krum", "median"],
)
def test_a_strategy_that_needs_more_than_half_says_so(strategy: Strategy, told: str | None):
    """A minority does not end a federation, whatever it sends: the round has no update, and its record says why."""
    clients, state = failing(7, 3), FederationState()
    found = federate(clients, START, SCHEDULE, edge(), strategy=strategy, state=state)
    unmoved = all((found.weights[name] == START[name]).all() for name in START)
    assert unmoved == (told is not None)
    failed = state.records[0].failed
    assert "no power" in failed["grid/cav0"]
    assert len(failed) == (3 if told is None else 7)
    if told is not None:
        assert re.match(told, failed["grid/cav6"])


def test_the_cloud_needs_every_edge_server():
    servers = {name: EdgeServer(failing(4, fail), 1, edge(), START) for name, fail in (("grid", 3), ("ring", 2))}
    with pytest.raises(ClientFailed, match=r"1 of 2 clients .*, 2 are wanted \(grid: .*1 of 4 clients"):
        federate(servers, START, SCHEDULE, edge(), rules=Rules().of_servers())


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "half", 10**6 + 1])
def test_bounds_that_make_no_sense_are_one_sentence(wrong: Any):
    with pytest.raises(ValidationError, match="expected 'all' or a whole number from 1 to 1000000") as caught:
        Rules(least_clients=wrong)
    assert caught.value.error_count() == 1
