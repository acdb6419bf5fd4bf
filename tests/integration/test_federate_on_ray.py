"""Flower's simulation on Ray: the weights of the embedded runtime, what clients keep included, also after a stop."""

from dataclasses import dataclass

import numpy as np
import pytest

from flcav.federation.links.metered import Account
from flcav.federation.links.ray import RaySimulation
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.robust import Krum
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.upload import Upload
from flcav.network.ledger import Ledger, LinkMegabytes

pytest.importorskip("ray", reason="the extra 'ray' is not installed")
pytestmark = pytest.mark.slow

SCHEDULE = Schedule(rounds=3, steps=2, learning_rate=0.1, final_learning_rate=0.05, seed=3)
START = {"layer.weight": np.ones((5, 3), np.float32), "norm.count": np.array([7])}


@dataclass
class Walker:
    """Walks at random, by a stride of its own; one falls after the first round."""

    stride: int

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, shift: Weights | None = None
    ) -> LocalUpdate:
        if self.stride == 8 and learning_rate < SCHEDULE.learning_rate:  # which falls after the first round
            raise OSError("no power")
        gradient = (self.stride * np.random.default_rng(seed).normal(size=(5, 3))).astype(np.float32)
        moved = weights["layer.weight"] + learning_rate * (gradient + (shift or {}).get("layer.weight", 0))
        after = {"layer.weight": moved.astype(np.float32), "norm.count": weights["norm.count"] + 1}
        return LocalUpdate(after, self.stride, 0.5, {"layer.weight": gradient})


CLIENTS = {f"cav{i}": Walker(stride) for i, stride in enumerate((3, 40, 1, 17, 8, 5))}


@pytest.mark.parametrize(
    ("strategy", "rules", "stopped"),
    [
        (FEDAVG, Rules(least_clients=4), 0),
        (Krum(), Rules(least_clients=5), 0),
        (Scaffold(), Rules(least_clients=4, upload=Upload(compression="none")), 1),
        (FEDAVG, Rules(least_clients=4, privacy=Privacy(where="local", clip=1.0, noise=1.0, seeded=True)), 0),
        (FEDAVG, Rules(least_clients=4, privacy=Privacy(where="local", clip=1.0, noise=1.0)), 0),
    ],
    ids=["fedavg", "krum", "scaffold", "seeded noise", "secret noise"],
)
def test_the_weights_on_ray_are_those_of_the_embedded_runtime(strategy: Strategy, rules: Rules, stopped: int):
    account, state = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "walk", "wireless"), FederationState()
    kept: dict[int, tuple[Weights, dict, list]] = {}

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        kept[number] = weights, {name: dict(kinds) for name, kinds in state.clients.items()}, [*state.records]
        kept[number][1].update({"": dict(state.server)})

    whole = federate(CLIENTS, START, SCHEDULE, account, strategy=strategy, rules=rules, state=state, on_round=keep)
    start, again = START, FederationState(secrets=state.secrets)
    if stopped:
        start, clients, again.records = kept[stopped]
        again.server = clients.pop("")
        again.clients = clients
    book = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "walk", "wireless")
    how = {"strategy": strategy, "rules": rules, "state": again, "done": stopped, "runtime": RaySimulation(2)}
    found = federate(CLIENTS, start, SCHEDULE, book, **how)
    np.testing.assert_allclose(found.weights["layer.weight"], whole.weights["layer.weight"], rtol=1e-6)
    assert again.to_arrays().keys() == state.to_arrays().keys()
    assert [record.clients for record in again.records] == [record.clients for record in state.records]
    assert "no power" in again.records[1].failed["cav4"]
    entries = [entry for entry in account.ledger.entries if entry.round > stopped]
    assert sorted(map(str, book.ledger.entries)) == sorted(map(str, entries))
