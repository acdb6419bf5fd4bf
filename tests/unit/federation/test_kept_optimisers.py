"""Optimisers that clients keep between rounds: momentum by hand, stops, processes, and who cannot keep them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from line_task import Line, LineTask, Slope
from regression import START, Regression, ledger, vehicles

from flcav.config import InputError
from flcav.federation.client import ClientAgreement
from flcav.federation.edge_server import EdgeServer
from flcav.federation.exchange import ClientFailed
from flcav.federation.links.link import open_link
from flcav.federation.links.metered import Account, open_account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.perception.client import TaskClient
from flcav.perception.weights import to_arrays
from flcav.statistics.streams import derive_seed

SCHEDULE = Schedule(rounds=4, steps=3, learning_rate=0.02, final_learning_rate=0.02, seed=3)
KEEP, MOMENTUM = Rules(keep_optimiser=True), 0.9


class Rolling(Regression):
    """Takes steps with momentum, which goes on from round to round where it is handed one."""

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, optimiser: Weights | None = None
    ) -> LocalUpdate:
        rng, w = np.random.default_rng(seed), weights["w"].astype(np.float64)
        velocity = (optimiser or {}).get("velocity", np.zeros(3))
        for _ in range(steps):
            i = rng.integers(len(self.inputs))
            velocity = MOMENTUM * velocity + 2 * (self.inputs[i] @ w - self.targets[i]) * self.inputs[i]
            w = w - learning_rate * velocity
        kept = {} if optimiser is None else {"velocity": velocity}
        found = LocalUpdate({"w": w.astype(np.float32), "count": weights["count"]}, len(self.inputs), 0.1)
        return replace(found, optimiser=kept)


CLIENTS = {name: Rolling(each.inputs, each.targets) for name, each in vehicles("grid", 3).items()}


def account() -> Account:
    return Account(ledger(), "edge", "regression", "wireless")


def by_hand(rounds: int, keep: bool) -> np.ndarray:
    """Return the weights of averaging by hand, with clients' velocities kept between rounds or not."""
    w, velocities = dict(START), dict[str, Any]()
    for number in range(1, rounds + 1):
        work, ends = SCHEDULE.work(number), []
        for name, client in CLIENTS.items():
            how: Any = {"steps": work.steps, "learning_rate": work.learning_rate, "seed": derive_seed(work.seed, name)}
            ends.append(client.train(w, **how, optimiser=velocities.get(name, {})))
            velocities[name] = ends[-1].optimiser if keep else {}
        mean = np.average([end.weights["w"].astype(float) for end in ends], axis=0, weights=[e.samples for e in ends])
        w = {**w, "w": mean.astype(np.float32)}
    return w["w"]


def test_velocities_go_on_where_they_are_kept_and_begin_anew_by_default():
    for rules, keep in ((KEEP, True), (Rules(), False)):
        found = federate(CLIENTS, START, SCHEDULE, account(), rules=rules).weights["w"]
        np.testing.assert_array_equal(found, by_hand(4, keep))
    assert not np.array_equal(by_hand(4, True), by_hand(4, False))


def test_a_resumed_federation_ends_with_the_same_bytes_and_nothing_of_the_state_is_sent():
    state, half, book = FederationState(), FederationState(), account()
    whole = federate(CLIENTS, START, SCHEDULE, book, rules=KEEP, state=state)
    first = federate(CLIENTS, START, replace(SCHEDULE, rounds=2), account(), rules=KEEP, state=half)
    arrays, again = half.to_arrays(), FederationState()
    assert {"client|grid/cav0|optimiser|velocity"} <= arrays.keys()
    again.restore(arrays, half.records)
    rest = federate(CLIENTS, first.weights, SCHEDULE, account(), rules=KEEP, state=again, done=2)
    np.testing.assert_array_equal(rest.weights["w"], whole.weights["w"])
    for name, array in state.to_arrays().items():
        np.testing.assert_array_equal(again.to_arrays()[name], array)
    plain = account()
    federate(CLIENTS, START, SCHEDULE, plain)
    assert book.ledger.entries == plain.ledger.entries


@pytest.mark.slow
def test_client_processes_keep_the_same_state():
    with ClientProcesses(CLIENTS, 2) as processes:
        found = federate(CLIENTS, START, SCHEDULE, account(), rules=KEEP, runtime=processes)
    np.testing.assert_array_equal(found.weights["w"], by_hand(4, True))


def test_it_goes_on_in_the_rounds_of_an_edge_server():
    server = EdgeServer(CLIENTS, 2, account(), START, rules=KEEP)
    federate({"grid": server}, START, replace(SCHEDULE, rounds=2), account(), rules=KEEP.of_servers())
    assert server.state.clients.keys() == CLIENTS.keys()
    assert all(np.any(own["optimiser"]["velocity"]) for own in server.state.clients.values())


@pytest.mark.slow
def test_adamw_goes_on_as_in_one_training():
    """One sample and two times three steps are six steps of PyTorch's own AdamW."""
    torch.manual_seed(1)
    network = Line(Slope())
    client, first = TaskClient(LineTask(), Slope(), [np.float32(1.5)]), to_arrays(network)  # type: ignore[arg-type]
    how: Any = {"steps": 3, "learning_rate": 0.1, "seed": 4}
    half = client.train(first, **how, optimiser={})
    found = client.train(half.weights, **how, optimiser=half.optimiser)
    anew = client.train(half.weights, **how)
    optimizer = torch.optim.AdamW(network.parameters(), lr=0.1, betas=(0.9, 0.99), weight_decay=0.01)
    for _ in range(6):
        optimizer.zero_grad()
        LineTask().loss(network, [np.float32(1.5)]).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
    for name, array in to_arrays(network).items():
        np.testing.assert_allclose(found.weights[name], array, rtol=1e-6)
        assert not np.allclose(anew.weights[name], array, rtol=1e-3)
    assert anew.optimiser == {}
    assert {str(each) for each in found.optimiser} == {
        f"{kind}/{name}" for kind in ("first", "second", "steps") for name in ("weight", "bias")
    }
    wrong: tuple[tuple[Any, str], ...] = (
        ({"first/weight": np.zeros(1)}, "state of an optimiser: 'first/bias' is missing or unknown"),
        ({**half.optimiser, "first/bias": np.zeros(7, np.float32)}, r"first: \(7,\) instead of \(1,\)"),
    )
    for state, told in wrong:
        with pytest.raises(InputError, match=told):
            client.train(first, **how, optimiser=state)


def test_who_cannot_keep_it_says_so(tmp_path: Path):
    plain = vehicles("grid", 3)
    with pytest.raises(InputError, match="keep_optimiser: needs clients whose training takes 'optimiser', and that of"):
        federate(plain, START, SCHEDULE, account(), rules=KEEP)
    with pytest.raises(InputError, match="'keep_optimiser' is for one"):
        federate(CLIENTS, START, SCHEDULE, account(), rules=KEEP, strategy=FedMD())

    class Forgets(Rolling):
        def train(self, weights: Weights, **how: Any) -> LocalUpdate:
            return replace(super().train(weights, **how), optimiser={})

    forgetful = {name: Forgets(each.inputs, each.targets) for name, each in plain.items()}
    with pytest.raises(ClientFailed, match="keep_optimiser: its update has no 'optimiser' to keep"):
        federate(forgetful, START, SCHEDULE, account(), rules=KEEP)

    class Far:
        deployed = True

    with (
        pytest.raises(InputError, match="keep_optimiser: the server's checkpoint would need the state of each"),
        open_link(CLIENTS, Far(), open_account(), ClientAgreement(FEDAVG, KEEP, {}, 0), {}),  # type: ignore[arg-type]
    ):
        pass


def test_a_training_that_diverges_leaves_the_state_as_it_was():
    class Diverges(Rolling):
        def train(self, weights: Weights, *, learning_rate: float, **how: Any) -> LocalUpdate:
            return super().train(weights, learning_rate=learning_rate * (1e300 if learning_rate < 0.015 else 1), **how)

    clients = {name: Diverges(each.inputs, each.targets) for name, each in CLIENTS.items()}
    state, schedule = FederationState(), replace(SCHEDULE, rounds=2, final_learning_rate=0.01)
    with pytest.raises(ClientFailed), np.errstate(all="ignore"):
        federate(clients, START, schedule, account(), rules=KEEP, state=state)
    assert all(np.isfinite(own["optimiser"]["velocity"]).all() for own in state.clients.values())
