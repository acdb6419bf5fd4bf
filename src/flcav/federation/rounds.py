"""Synchronous federated rounds with full participation, as a Flower strategy.

In each round every client trains, and `Strategy.combine` aggregates the updates in the order of the nodes. Flower's own
strategies sample nodes from the global random state and multiply integer buffers by floats.
"""

from collections.abc import Callable, Iterable

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MessageType, MetricRecord, RecordDict
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Strategy as FlowerStrategy

from flcav.federation.records import ARRAYS, CONFIG, LOSS, SAMPLES, LocalWork, to_arrays, to_update, to_weights
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Weights

OnRound = Callable[[int, Weights, float], None]  # number of the aggregated round, its weights, mean training loss


class ClientFailed(RuntimeError):
    """A client replied to a round with an error."""


class Rounds(FlowerStrategy):
    """Flower strategy in which every node trains in every round; `strategy` aggregates their updates.

    `work` gives the local training of a round by its number; numbers continue after the `done` rounds. `on_round` is
    called after each aggregation.
    """

    def __init__(self, strategy: Strategy, work: Callable[[int], LocalWork], done: int, on_round: OnRound) -> None:
        self._strategy, self._work, self._done, self._on_round = strategy, work, done, on_round
        self._start: Weights = {}

    def summary(self) -> None:
        """Log nothing: the stage's own records hold the settings."""

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return one training message per node: the round's weights and its local work."""
        self._start = to_weights(arrays)
        content = RecordDict({ARRAYS: arrays, CONFIG: self._work(self._done + server_round).record()})
        return [
            Message(content=content, message_type=MessageType.TRAIN, dst_node_id=node) for node in grid.get_node_ids()
        ]

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Return the aggregated weights, and as metrics the number of samples and the mean loss weighted by samples.

        Raises `ClientFailed` where a reply is an error, ValueError where the strategy returns arrays of other names,
        shapes or types.
        """
        ordered = sorted(replies, key=lambda message: message.metadata.src_node_id)
        for message in ordered:
            if message.has_error():
                raise ClientFailed(f"node {message.metadata.src_node_id}: {message.error.reason}")
        updates = [to_update(message) for message in ordered]
        weights = self._strategy.combine(self._start, updates)
        if _form(weights) != _form(self._start):
            name = type(self._strategy).__name__
            raise ValueError(f"{name} returned arrays of other names, shapes or types than the round started from")
        samples = [update.samples for update in updates]
        loss = float(np.average([update.loss for update in updates], weights=samples))
        self._on_round(self._done + server_round, weights, loss)
        return to_arrays(weights), MetricRecord({SAMPLES: sum(samples), LOSS: loss})

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return no messages: vehicles have no ground truth for an evaluation."""
        return []

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Return None: clients do not evaluate."""
        return None


def _form(weights: Weights) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    return {name: (array.shape, array.dtype) for name, array in weights.items()}
