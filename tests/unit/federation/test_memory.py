"""Memory of a round: clients are made when it is their turn, and a mean needs one update at a time."""

import tracemalloc
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest

from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.fedopt import FedAdam
from flcav.federation.strategies.robust import Median
from flcav.federation.strategies.strategy import find_weigher
from flcav.federation.trainable import LocalUpdate, Trainable, Update, Weights
from flcav.network.ledger import Ledger, LinkMegabytes

FEW, MANY = 10, 50
START = {"w": np.zeros(100_000, np.float32)}


class Vehicle:
    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        return LocalUpdate({"w": weights["w"] + np.float32(seed % 7)}, 1 + seed % 3, 0.5)


class Fleet(Mapping[str, Trainable]):
    """Vehicles with data of their own, made when they are asked for."""

    def __init__(self, count: int) -> None:
        self.count, self.made = count, 0

    def __getitem__(self, name: str) -> Trainable:
        self.made += 1
        found = Vehicle()
        found.data = np.ones(100_000, np.float32)  # type: ignore[attr-defined]
        return found

    def __iter__(self) -> Iterator[str]:
        return (f"cav{number}" for number in range(self.count))

    def __len__(self) -> int:
        return self.count


def peak(count: int, strategy: Strategy) -> int:
    fleet, account = Fleet(count), Account(Ledger(LinkMegabytes(1e3, 1e3)), "edge", "toy", "wireless")
    tracemalloc.start()
    try:
        federate(fleet, START, Schedule(1, 1, 0.1, 0.1, 0), account, strategy=strategy)
        assert fleet.made == count
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("strategy", [FEDAVG, FedAdam()], ids=["fedavg", "fedadam"])
def test_peak_memory_does_not_grow_with_the_vehicles(strategy: Strategy):
    assert peak(MANY, strategy) < 1.2 * peak(FEW, strategy)


def test_the_median_holds_every_update():
    assert peak(MANY, Median()) - peak(FEW, Median()) > (MANY - FEW) * START["w"].nbytes


def test_a_strategy_that_overrides_the_mean_is_given_every_update():
    class ByLoss(FedAvg):
        def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
            return updates[0].weights

    assert find_weigher(FEDAVG) is FEDAVG
    assert find_weigher(ByLoss()) is None
    assert find_weigher(Median()) is None
