"""The federated stages: II, vehicles with their edge server; III, edge servers with the cloud.

Both are one loop (`federate`): stage III's clients are edge servers, and an edge server's local training is k rounds of
its own region's federation.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from flwr.app import ArrayRecord

from flcav.config import InputError
from flcav.federation.client import CLIENT, client_app
from flcav.federation.records import LOSS, SAMPLES, LocalWork, to_arrays, to_weights
from flcav.federation.rounds import OnRound, Rounds
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.metered import Account, MeteredGrid
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.seeds import child_seed

logging.getLogger("flwr").setLevel(logging.ERROR)  # Flower logs each round; a stage reports its own


@dataclass(frozen=True)
class Schedule:
    """What the clients of a federation do in its rounds."""

    rounds: int
    steps: int  # local steps per round
    learning_rate: float  # in the first round
    final_learning_rate: float  # in the last; geometric between
    seed: int

    def work(self, round_: int) -> LocalWork:
        """Return the local work of a 1-based round."""
        progress = (round_ - 1) / max(self.rounds - 1, 1)
        rate = self.learning_rate * (self.final_learning_rate / self.learning_rate) ** progress
        return LocalWork(round_, self.steps, rate, child_seed(self.seed, "round", round_))


def _ignore(round_: int, weights: Weights, loss: float) -> None:
    pass


def federate(
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account,
    *,
    strategy: Strategy = FEDAVG,
    done: int = 0,
    on_round: OnRound = _ignore,
) -> LocalUpdate:
    """Run rounds `done + 1 .. schedule.rounds` of one federation from `weights` and return what it ends with.

    `strategy` makes each round's weights of its clients' updates. Every message is booked on `account`; raises
    `BudgetExceeded` where one cannot be paid, `ClientFailed` where a client raised, `InputError` without clients. To
    resume, pass the same strategy, and the weights and the number of the last round that `on_round` was given. With the
    default it is federated averaging (McMahan et al., AISTATS 2017, algorithm 1).

    >>> import numpy as np
    >>> from flcav import Ledger, federate
    >>> from flcav.federation import Account, LocalUpdate, Schedule
    >>> from flcav.network import Budget
    >>> class Vehicle:  # of a task: flcav.perception.TaskClient
    ...     def __init__(self, samples):
    ...         self.samples = samples
    ...     def train(self, weights, *, steps, learning_rate, seed):
    ...         return LocalUpdate({"w": weights["w"] + self.samples}, self.samples, loss=0.0)
    >>> ledger = Ledger(Budget(wireless_mb=1.0, wireline_mb=0.0))
    >>> schedule = Schedule(rounds=1, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=0)
    >>> vehicles = {"cav0": Vehicle(1), "cav1": Vehicle(3)}
    >>> federate(vehicles, {"w": np.zeros(2)}, schedule, Account(ledger, "edge", "toy", "wireless")).weights["w"]
    array([2.5, 2.5])
    """
    if not clients:
        raise InputError("a federation of 0 clients: nobody trains")
    if schedule.rounds <= done:
        return LocalUpdate(weights, 0, 0.0)
    nodes = {name: {CLIENT: name} for name in clients}
    with EmbeddedGrid(client_app(clients), nodes) as grid:
        metered = MeteredGrid(grid, account, grid.names)
        rounds = Rounds(strategy, schedule.work, done, on_round)
        result = rounds.start(metered, to_arrays(weights), schedule.rounds - done)
    arrays: ArrayRecord = result.arrays
    metrics = result.train_metrics_clientapp[schedule.rounds - done]
    return LocalUpdate(to_weights(arrays), int(metrics[SAMPLES]), float(metrics[LOSS]))  # type: ignore[arg-type]


@dataclass
class EdgeServer:
    """A region's edge server as a client of the cloud: its local training is k edge rounds with its vehicles."""

    vehicles: Mapping[str, Trainable]
    edge_rounds: int  # k >= 1
    account: Account  # wireless
    own: Weights  # its stage II model
    cloud_rounds_done: int = 0
    strategy: Strategy = FEDAVG  # of its region

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the region's model after k edge rounds from the cloud's model.

        The first cloud round starts from the server's own stage II model: the cloud has not averaged yet, and what it
        holds is older. Edge rounds are numbered on through the cloud rounds.
        """
        start = weights if self.cloud_rounds_done else self.own
        done = self.cloud_rounds_done * self.edge_rounds
        schedule = Schedule(done + self.edge_rounds, steps, learning_rate, learning_rate, seed)
        update = federate(self.vehicles, start, schedule, self.account, strategy=self.strategy, done=done)
        self.cloud_rounds_done += 1
        return update
