"""What every strategy keeps to: those of the package, and the one that the example brings."""

import importlib.util
import json
import pickle
import random
import sys
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from flcav.federation.exchange import ClientFailed
from flcav.federation.links.metered import Account, MeteredGrid
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState, RoundRecord
from flcav.federation.strategies import STRATEGIES, FedAvg, Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Stateful
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.runs.engine import Step
from flcav.runs.recipe import Federation, load_run_recipe
from flcav.runs.stages.graph import Graph
from flcav.sources.recipe import recipe_path

EXAMPLE = Path(__file__).parents[2] / "examples" / "06_bring_your_own_strategy.py"
SCHEDULE = Schedule(rounds=3, steps=2, learning_rate=0.1, final_learning_rate=0.05, seed=3)
START = {"layer.weight": np.ones((5, 3), np.float32), "norm.count": np.array([7])}


class Client:
    """Walks at random, by a stride and a number of samples of its own."""

    def __init__(self, samples: int) -> None:
        self.samples = samples

    def train(
        self,
        weights: Weights,
        *,
        steps: int,
        learning_rate: float,
        seed: int,
        proximal: float = 0.0,
        shift: Weights | None = None,
        own: Weights | None = None,
        imitation_steps: int = 0,
    ) -> LocalUpdate:
        rng = np.random.default_rng(seed)
        gradient = (self.samples * rng.normal(size=(5, 3))).astype(np.float32)
        corrected = gradient + proximal * weights["layer.weight"] + (shift or {}).get("layer.weight", 0)
        moved = {
            "layer.weight": (weights["layer.weight"] + learning_rate * corrected).astype(np.float32),
            "norm.count": weights["norm.count"] + self.samples,
        }
        loss, kept = float(rng.uniform(0.1, 2.0)), {}
        if own is not None:  # what it keeps changes what it sends
            kept = {"drift": own.get("drift", np.zeros((5, 3), np.float32)) + np.float32(imitation_steps) * gradient}
            moved["layer.weight"] = moved["layer.weight"] + np.float32(learning_rate) * kept["drift"]
        return LocalUpdate(moved, self.samples, loss, {"layer.weight": gradient}, own=kept)


def of_the_example() -> type[Strategy]:
    spec = importlib.util.spec_from_file_location(EXAMPLE.stem, EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[EXAMPLE.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.LossWeighted


class Other(FedAvg):
    """Does the same, and is another."""


KINDS: dict[str, type[Strategy]] = {**STRATEGIES, "example": of_the_example()}
CLIENTS = {f"cav{i}": Client(samples) for i, samples in enumerate((3, 40, 1, 17, 8))}


@pytest.fixture(params=KINDS.values(), ids=[*KINDS])
def strategy(request: pytest.FixtureRequest) -> Strategy:
    return among(CLIENTS, request.param())


def among(clients: Mapping[str, Any], strategy: Strategy) -> Strategy:
    """Return the strategy with rounds of all clients."""
    return replace(strategy, buffer=len(clients)) if isinstance(strategy, FedBuff) else strategy


def federated(strategy: Strategy, start: Weights = START, **how: Any) -> Weights:
    account = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "walk", "wireless")
    return federate(CLIENTS, start, SCHEDULE, account, strategy=strategy, **how).weights


def updates() -> list[LocalUpdate]:
    return [client.train(START, steps=2, learning_rate=0.1, seed=seed) for seed, client in enumerate(CLIENTS.values())]


def same(one: Weights, other: Weights) -> bool:
    return all(one[name].tobytes() == other[name].tobytes() for name in (*START, *one, *other))


def test_it_is_deterministic_and_changes_nothing_it_is_given(strategy):
    given, start = updates(), {name: array.copy() for name, array in START.items()}
    once = strategy.combine(start, given)
    for seed in (1, 2):
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - what a strategy must not draw from
        torch.manual_seed(seed)
        assert same(strategy.combine(start, given), once)
    assert same(start, START)
    assert all(same(update.weights, fresh.weights) for update, fresh in zip(given, updates(), strict=True))


def test_it_returns_arrays_as_it_was_given_them(strategy):
    combined = strategy.combine(START, updates())
    assert {name: (a.shape, a.dtype) for name, a in combined.items()} == {
        name: (a.shape, a.dtype) for name, a in START.items()
    }
    assert all(np.isfinite(array).all() for array in combined.values())
    assert not np.array_equal(combined["layer.weight"], START["layer.weight"])


def test_replies_are_combined_in_node_order_however_they_come_in(strategy, monkeypatch: pytest.MonkeyPatch):
    in_order = federated(strategy)
    receive, arrived = MeteredGrid.send_and_receive, []

    def shuffled(grid, messages, **options):
        replies = list(receive(grid, messages, **options))
        arrived.append(len(replies))
        return [replies[i] for i in (3, 0, 4, 2, 1)] if replies else replies

    monkeypatch.setattr(MeteredGrid, "send_and_receive", shuffled)
    assert same(federated(strategy), in_order)
    assert arrived.count(len(CLIENTS)) == SCHEDULE.rounds


def test_no_client_is_special(strategy):
    given = updates()
    one, other = (strategy.combine(START, order)["layer.weight"] for order in (given, given[::-1]))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_without_state_it_keeps_nothing_between_rounds(strategy):
    if isinstance(strategy, Stateful | FedMD):
        pytest.skip("has a state, on the server or on clients, which is checkpointed")
    kept: list[Weights] = []
    whole = federated(strategy, on_round=lambda number, weights, loss: kept.append(weights))
    for done in (1, 2):
        assert same(federated(replace(strategy), kept[done - 1], done=done), whole)


def test_it_resumes_from_weights_and_state_to_the_same_bits(strategy):
    state, kept = FederationState(), []

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        arrays = {name: array.copy() for name, array in state.to_arrays().items()}
        kept.append((weights, arrays, [record.as_json() for record in state.records]))

    whole = federated(strategy, on_round=keep, state=state)
    last = kept[-1]
    assert isinstance(strategy, Stateful) == bool(state.server)
    for done in (1, 2):
        weights, arrays, records = kept[done - 1]
        resumed = FederationState()
        resumed.restore(
            load(save(arrays)), [RoundRecord.from_json(each, "") for each in json.loads(json.dumps(records))]
        )
        assert same(federated(replace(strategy), weights, done=done, state=resumed), whole)
        assert save(resumed.to_arrays()) == save(last[1])
        assert resumed.records == state.records


def test_a_client_that_fails_is_named_and_the_others_go_on(strategy):
    class Failing(Client):
        def train(self, weights: Weights, **how: Any) -> LocalUpdate:
            update = super().train(weights, **how)
            if self.samples == 17:
                raise OSError("no power")
            moved = dict(update.weights)
            moved["layer.weight"] = {8: np.full((5, 3), np.nan, np.float32), 9: np.zeros((2, 3), np.float32)}.get(
                self.samples, moved["layer.weight"]
            )
            return replace(update, weights=moved)

    clients = {f"cav{i}": Failing(samples) for i, samples in enumerate((3, 40, 1, 17, 8, 9, 5, 6))}
    account, state = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "walk", "wireless"), FederationState()
    rules = Rules(least_clients=5)
    strategy = among(clients, strategy)
    result = federate(clients, START, SCHEDULE, account, strategy=strategy, rules=rules, state=state)
    usable = {name: client for name, client in clients.items() if client.samples not in (8, 9, 17)}
    assert [record.clients for record in state.records] == [tuple(usable)] * SCHEDULE.rounds
    assert {name: reason.split("(")[0] for name, reason in state.records[0].failed.items()} == {
        "cav3": "OSError",
        "cav4": "'layer.weight' has values that are not finite",
        "cav5": "'layer.weight' is float32 ",
    }
    account = replace(account, ledger=Ledger(LinkMegabytes(1.0, 1.0)))
    alone = federate(usable, START, SCHEDULE, account, strategy=among(usable, strategy))
    if type(strategy).__name__ != "Scaffold":  # whose server counts all clients
        assert same(result.weights, alone.weights)
    with pytest.raises(ClientFailed, match=r"round 1: 5 of 8 clients .* 6 are wanted \(cav3: OSError.*no power.*cav4"):
        federate(clients, START, SCHEDULE, account, strategy=strategy, rules=Rules(least_clients=6))


def test_it_travels_to_the_step_that_federates_and_is_in_its_fingerprint(strategy):
    def print_of(arguments: Any) -> str:
        return Step("edge", federated, {"strategy": arguments}).fingerprint({})

    settings: dict[str, Any] = {field.name: getattr(strategy, field.name) for field in fields(strategy)}
    assert json.loads(json.dumps(settings)) == settings
    assert pickle.loads(pickle.dumps(strategy)) == strategy
    assert len({print_of(kind()) for kind in KINDS.values()}) == len(KINDS)
    numbers = [name for name, value in settings.items() if isinstance(value, int | float)]
    changed = [replace(strategy, **{name: settings[name] + 1}) for name in numbers]
    assert len({print_of(each) for each in (strategy, *changed)}) == 1 + len(numbers)


def test_another_strategy_leaves_what_comes_before_it_as_it_is():
    def prints(of: str) -> dict[str, str]:
        recipe = load_run_recipe(recipe_path("runs/demo_road"))
        changed = recipe.model_copy(update={"federation": Federation(strategy=of)})
        found: dict[str, str] = {}
        for step in Graph(changed, Path()).steps:
            found[step.name] = step.fingerprint(found)
        return found

    one, other = prints("fedavg"), prints("fedadam")
    changed = {name for name in one if one[name] != other[name]}
    federated = {"grid-edge-fl-objects", "grid-edge-fl-objects-densest", "ring-edge-fl-objects", "cloud-fl-objects"}
    assert federated | {"test-cloud-fl-objects-grid"} <= changed
    before = {"pretrain-objects", "grid-place", "grid-edge-objects", "test-pretrain-objects-grid"}
    assert before <= set(one)
    assert before.isdisjoint(changed)
