"""Federated averaging (McMahan et al., AISTATS 2017, algorithm 1) as a deterministic Flower strategy.

Flower's own picks nodes by the global random state and multiplies integer buffers by floats; this one asks every node,
sums in node order, and averages by type.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MessageType, MetricRecord, RecordDict
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Strategy

from flcav.federation.records import ARRAYS, CONFIG, LOSS, METRICS, SAMPLES, LocalWork, to_arrays, to_weights
from flcav.federation.trainable import Weights


class ClientFailed(RuntimeError):
    """A client answered a round with an error."""


def average(weights: Sequence[Weights], samples: Sequence[float]) -> dict[str, np.ndarray]:
    """Return the sample-weighted mean of floating arrays (summed in float64); of others, the first client's.

    Raises ValueError where the clients' arrays differ in name, order or shape.
    """
    first = weights[0]
    for other in weights[1:]:
        if [(n, a.shape) for n, a in first.items()] != [(n, a.shape) for n, a in other.items()]:
            raise ValueError("clients sent arrays of different names or shapes: they train different networks")
    share = np.asarray(samples, dtype=np.float64) / np.sum(samples)

    def combined(name: str) -> np.ndarray:
        array = first[name]
        if not np.issubdtype(array.dtype, np.floating):
            return array
        total = sum(s * w[name].astype(np.float64) for s, w in zip(share, weights, strict=True))
        return np.asarray(total).astype(array.dtype)

    return {name: combined(name) for name in first}


class FedAvg(Strategy):
    """Every node trains every round; `work(round)` says how."""

    def __init__(self, work: Callable[[int], LocalWork]) -> None:
        """Ask for `work(server_round)` in each round; a resumed federation offsets the round itself."""
        self._work = work

    def summary(self) -> None:
        """Log nothing: the stage's own records say what was run."""

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return one training message per node."""
        content = RecordDict({ARRAYS: arrays, CONFIG: self._work(server_round).record()})
        return [
            Message(content=content, message_type=MessageType.TRAIN, dst_node_id=node) for node in grid.get_node_ids()
        ]

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Return the average of all replies, in node order; raises `ClientFailed` where one is an error."""
        ordered = sorted(replies, key=lambda message: message.metadata.src_node_id)
        for message in ordered:
            if message.has_error():
                raise ClientFailed(f"node {message.metadata.src_node_id}: {message.error.reason}")
        contents = [message.content for message in ordered]
        samples = [float(content.metric_records[METRICS][SAMPLES]) for content in contents]  # type: ignore[arg-type]
        losses = [float(content.metric_records[METRICS][LOSS]) for content in contents]  # type: ignore[arg-type]
        arrays = average([to_weights(content.array_records[ARRAYS]) for content in contents], samples)
        metrics = MetricRecord({SAMPLES: sum(samples), LOSS: float(np.average(losses, weights=samples))})
        return to_arrays(arrays), metrics

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Return no messages: vehicles have no ground truth to evaluate on."""
        return []

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Return nothing."""
        return None
