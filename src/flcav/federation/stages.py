"""The federated stages: II, vehicles with their edge server; III, edge servers with the cloud.

Both are one loop (`federate`): stage III's clients are edge servers, and an edge server's local training is k rounds of
its own region's federation.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from flwr.app import ArrayRecord

from flcav.config import InputError
from flcav.federation.client import CLIENT, client_app
from flcav.federation.records import LOSS, SAMPLES, LocalWork, to_arrays, to_weights
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.metered import Account, MeteredGrid
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.seeds import child_seed

logging.getLogger("flwr").setLevel(logging.ERROR)  # Flower logs each round; a stage reports its own

OnRound = Callable[[int, Weights, float], None]  # round just aggregated, its weights, mean training loss


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


class _Rounds(FedAvg):
    """FedAvg that hands each aggregated round on, and numbers rounds from where a resumed federation stopped."""

    def __init__(self, schedule: Schedule, done: int, on_round: OnRound) -> None:
        super().__init__(lambda server_round: schedule.work(done + server_round))
        self._done, self._on_round = done, on_round

    def aggregate_train(self, server_round, replies):
        arrays, metrics = super().aggregate_train(server_round, replies)
        if arrays is not None and metrics is not None:
            self._on_round(self._done + server_round, to_weights(arrays), float(metrics[LOSS]))  # type: ignore[arg-type]
        return arrays, metrics


def _ignore(round_: int, weights: Weights, loss: float) -> None:
    pass


def federate(
    clients: Mapping[str, Trainable],
    weights: Weights,
    schedule: Schedule,
    account: Account,
    *,
    done: int = 0,
    on_round: OnRound = _ignore,
) -> LocalUpdate:
    """Run rounds `done + 1 .. schedule.rounds` of one federation from `weights` and return what it ends with.

    Every message is booked on `account`; raises `BudgetExceeded` where one cannot be paid, `ClientFailed` where a
    client raised, `InputError` without clients. To resume, pass the weights and the number of the last round that
    `on_round` was given.
    """
    if not clients:
        raise InputError("a federation of 0 clients: nobody trains")
    if schedule.rounds <= done:
        return LocalUpdate(weights, 0, 0.0)
    nodes = {name: {CLIENT: name} for name in clients}
    with EmbeddedGrid(client_app(clients), nodes) as grid:
        metered = MeteredGrid(grid, account, grid.names)
        result = _Rounds(schedule, done, on_round).start(metered, to_arrays(weights), schedule.rounds - done)
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

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the region's model after k edge rounds from the cloud's model.

        The first cloud round starts from the server's own stage II model: the cloud has not averaged yet, and what it
        holds is older. Edge rounds are numbered on through the cloud rounds.
        """
        start = weights if self.cloud_rounds_done else self.own
        done = self.cloud_rounds_done * self.edge_rounds
        schedule = Schedule(done + self.edge_rounds, steps, learning_rate, learning_rate, seed)
        update = federate(self.vehicles, start, schedule, self.account, done=done)
        self.cloud_rounds_done += 1
        return update
