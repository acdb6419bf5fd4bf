"""Synchronous federated rounds as a Flower strategy: who trains, whose updates count, and how they are combined.

Flower's own strategies sample nodes from the global random state, multiply integer buffers by floats, and skip a whole
round where one client fails.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MessageType, MetricRecord, RecordDict
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Strategy as FlowerStrategy

from flcav.federation.records import ARRAYS, CONFIG, EXTRA, LOSS, SAMPLES, LocalWork, to_arrays, to_update, to_weights
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState, RoundRecord
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.strategy import Exchanges, Stateful
from flcav.federation.trainable import LocalUpdate, Weights

OnRound = Callable[[int, Weights, float], None]  # number of the aggregated round, its weights, mean training loss


class ClientFailed(RuntimeError):
    """Fewer clients sent a usable update in a round than are wanted."""


class Rounds(FlowerStrategy):
    """Flower strategy of a federation: in each round clients train, and `strategy` combines their updates.

    `work` gives the local training of a round by its number; numbers continue after the `done` rounds. `names` are the
    clients' names by node. `state` is changed in place; `on_round` is called after each aggregation.
    """

    def __init__(
        self,
        strategy: Strategy,
        rules: Rules,
        work: Callable[[int], LocalWork],
        names: Mapping[int, str],
        state: FederationState,
        done: int,
        on_round: OnRound,
    ) -> None:
        self._strategy, self._rules, self._work, self._names = strategy, rules, work, names
        self._state, self._done, self._on_round = state, done, on_round
        self._start: Weights = {}

    def summary(self) -> None:
        """Log nothing: the stage's own records hold the settings."""

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return one training message per node: the round's weights and its local work."""
        self._start = to_weights(arrays)
        records = {ARRAYS: arrays}
        if isinstance(self._strategy, Exchanges) and (sent := self._strategy.send(self._state.server)):
            records[EXTRA] = to_arrays(sent)
        content = RecordDict({**records, CONFIG: self._work(self._done + server_round).record()})
        return [
            Message(content=content, message_type=MessageType.TRAIN, dst_node_id=node) for node in grid.get_node_ids()
        ]

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Return the aggregated weights, and as metrics the number of samples and the mean loss weighted by samples.

        Raises `ClientFailed` where fewer clients than are wanted sent a usable update, ValueError where the strategy
        returns arrays of other names, shapes or types.
        """
        number = self._done + server_round
        updates, failed = self._receive(replies)
        wanted = len(self._names) if self._rules.least_clients is None else self._rules.least_clients
        if len(updates) < wanted:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
            raise ClientFailed(
                f"round {number}: {len(updates)} of {len(self._names)} clients sent an update that can be used, "
                f"{wanted} are wanted ({reasons})"
            )
        weights = self._combine(list(updates.values()))
        samples = [update.samples for update in updates.values()]
        loss = float(np.average([update.loss for update in updates.values()], weights=samples))
        self._state.records.append(RoundRecord(number, tuple(updates), failed))
        self._on_round(number, weights, loss)
        return to_arrays(weights), MetricRecord({SAMPLES: sum(samples), LOSS: loss})

    def _receive(self, replies: Iterable[Message]) -> tuple[dict[str, LocalUpdate], dict[str, str]]:
        """Return the usable updates by client, in node order, and by client what is wrong with the others."""
        updates: dict[str, LocalUpdate] = {}
        failed: dict[str, str] = {}
        for message in sorted(replies, key=lambda message: message.metadata.src_node_id):
            name = self._names[message.metadata.src_node_id]
            if message.has_error():
                failed[name] = message.error.reason
                continue
            try:
                update = to_update(message)
            except (KeyError, TypeError, ValueError) as error:
                failed[name] = f"a message that is no update ({error!r})"
                continue
            others = next(iter(updates.values())).extra if updates else update.extra
            fault = find_fault(update, self._start, others)
            if fault is None:
                updates[name] = update
            else:
                failed[name] = fault
        return updates, failed

    def _combine(self, updates: list[LocalUpdate]) -> Weights:
        """Return the weights after the round, and change the strategy's state."""
        if isinstance(self._strategy, Stateful):
            state = self._state.server
            weights, after = self._strategy.step(self._start, updates, state, len(self._names))
            self._state.server = {name: np.asarray(array) for name, array in after.items()}
        else:
            weights = self._strategy.combine(self._start, updates)
        if _form(weights) != _form(self._start):
            name = type(self._strategy).__name__
            raise ValueError(f"{name} returned arrays of other names, shapes or types than the round started from")
        return weights

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return no messages: vehicles have no ground truth for an evaluation."""
        return []

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Return None: clients do not evaluate."""
        return None


def find_fault(update: LocalUpdate, start: Weights, extra: Weights) -> str | None:
    """Return what makes an update unusable, None for a usable one.

    `start` has the names, shapes and types that the weights must have, `extra` those of the arrays beside them.
    """
    for arrays, like in ((update.weights, start), (update.extra, extra)):
        if set(arrays) != set(like):
            odd = sorted(set(arrays) ^ set(like))
            return f"an array '{odd[0]}' that is missing or unknown"
        for name, array in arrays.items():
            if (array.shape, array.dtype) != (like[name].shape, like[name].dtype):
                return f"'{name}' is {array.dtype} {array.shape} instead of {like[name].dtype} {like[name].shape}"
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                return f"'{name}' has values that are not finite"
    if update.samples < 0 or not np.isfinite(update.loss):
        return f"{update.samples} samples and a loss of {update.loss}"
    return None


def _form(weights: Weights) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    return {name: (array.shape, array.dtype) for name, array in weights.items()}
