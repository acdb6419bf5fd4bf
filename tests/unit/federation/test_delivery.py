"""What clients keep between rounds changes with the updates that the server gets and can use, and with no others."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from regression import ledger

from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.upload import Upload
from flcav.network.ledger import BudgetExceeded

START = {"w": np.zeros((4, 5)), "v": np.ones(3)}
NAMES = ("cav0", "cav1", "cav2")
SCHEDULE = Schedule(rounds=3, steps=2, learning_rate=0.1, final_learning_rate=0.1, seed=3)
TOP_K = Rules(upload=Upload(compression="top-k", fraction=0.2))
KEEPERS = {"top-k": (FEDAVG, TOP_K, "residual"), "scaffold": (Scaffold(), Rules(), "own")}
SECOND: tuple[int, str] = (2, "cav1")  # round and client
NETWORK = {
    "late": Outage("past the deadline", 40),
    "not there": Outage("not in the town"),
}
WRONG: Mapping[str, Any] = {
    "nan": lambda found: replace(found, weights={**found.weights, "w": np.where(np.eye(4, 5), np.nan, 0.1)}),
    "infinite loss": lambda found: replace(found, loss=float("inf")),
    "shape": lambda found: replace(found, weights={**found.weights, "w": np.zeros((2, 4, 5))}),
    "name": lambda found: replace(found, weights={"w": found.weights["w"]}),
    "negative": lambda found: replace(found, samples=-1),
}


class Walk:
    """Walks at random, and spoils its update of the second round by `wrong`."""

    def __init__(self, wrong: str | None = None) -> None:
        self.wrong, self.calls = wrong, 0

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, shift: Weights | None = None
    ) -> LocalUpdate:
        self.calls += 1
        rng = np.random.default_rng(seed)
        gradient = {name: rng.normal(size=array.shape) for name, array in weights.items()}
        moved = {
            name: weights[name] - learning_rate * (each + (shift or {}).get(name, 0)) for name, each in gradient.items()
        }
        found = LocalUpdate(moved, 3, 0.5, gradient)
        return WRONG[self.wrong](found) if self.wrong and self.calls == 2 else found


def run(
    strategy: Strategy,
    rules: Rules,
    outages: Mapping[tuple[int, str], Outage] = {},
    wrong: str | None = None,
    wireless_mb: float = 1.0,
) -> tuple[Weights, FederationState, list[dict[str, np.ndarray]], Account]:
    """Return the weights, the state, and the state's arrays after each round."""
    state, after = FederationState(), []

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        after.append({name: np.array(array) for name, array in state.to_arrays().items()})

    account = Account(ledger(wireless_mb), "edge", "walk", "wireless", outages)
    clients = {name: Walk(wrong if name == "cav1" else None) for name in NAMES}
    how: Any = {"strategy": strategy, "rules": rules, "state": state, "on_round": keep}
    try:
        return federate(clients, START, SCHEDULE, account, **how).weights, state, after, account
    except BudgetExceeded:
        return {}, state, after, account


@pytest.mark.parametrize("keeper", KEEPERS)
@pytest.mark.parametrize("what", [*NETWORK, *WRONG])
def test_an_update_that_does_not_count_leaves_what_its_client_keeps(keeper: str, what: str) -> None:
    strategy, rules, kind = KEEPERS[keeper]
    outages = {SECOND: NETWORK[what]} if what in NETWORK else {}
    _, state, after, _ = run(strategy, rules, outages, None if outages else what)
    assert [record.clients for record in state.records] == [NAMES, ("cav0", "cav2"), NAMES]
    assert state.records[1].failed.keys() == {"cav1"}
    for client in NAMES:
        keys = [key for key in after[0] if key.startswith(f"client|{client}|{kind}|")]
        assert keys
        for key in keys:
            assert np.array_equal(after[1][key], after[0][key]) == (client == "cav1"), key
            assert not np.array_equal(after[2][key], after[1][key])


@pytest.mark.parametrize("outage", NETWORK.values(), ids=NETWORK)
def test_scaffold_s_server_keeps_the_mean_of_the_clients_variates_where_updates_are_lost(outage: Outage) -> None:
    _, state, _, _ = run(Scaffold(), Rules(), {SECOND: outage, (3, "cav0"): outage})
    for name, array in state.server.items():
        mean = np.mean([state.clients[client]["own"][name] for client in NAMES], axis=0)
        np.testing.assert_allclose(array, mean, atol=1e-12)


def test_top_k_of_all_coordinates_is_as_no_compression_where_updates_are_lost() -> None:
    outages = {SECOND: NETWORK["late"]}
    whole, plain = Rules(upload=Upload(compression="top-k", fraction=1.0)), Rules()
    found, expected = (run(FEDAVG, rules, outages)[0] for rules in (whole, plain))
    for name, array in expected.items():
        np.testing.assert_allclose(found[name], array, atol=1e-6)


@pytest.mark.parametrize("keeper", KEEPERS)
def test_a_round_that_ends_over_the_budget_leaves_the_state_of_the_round_before(keeper: str) -> None:
    strategy, rules, _ = KEEPERS[keeper]
    whole = run(strategy, rules)[3].ledger.used_mb("wireless")
    _, state, after, account = run(strategy, rules, wireless_mb=whole * 5.5 / 9)  # of nine updates, for five
    assert [entry.direction for entry in account.ledger.entries].count("up") == 5
    assert len(state.records) == len(after) == 1
    left = state.to_arrays()
    assert left.keys() == after[0].keys()
    assert all(np.array_equal(left[key], after[0][key]) for key in left)


def test_what_a_client_is_told_of_its_outage_is_in_no_message() -> None:
    lost, plain = (run(FEDAVG, TOP_K, outages)[3].ledger for outages in ({SECOND: NETWORK["late"]}, {}))
    down = [[entry.bytes for entry in book.entries if entry.direction == "down"] for book in (lost, plain)]
    assert down[0] == down[1]
