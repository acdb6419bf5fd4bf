"""Between the weights a task knows and the records Flower sends."""

from dataclasses import dataclass

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict

from flcav.federation.trainable import LocalUpdate, Update, Weights

ARRAYS, CONFIG, METRICS = "arrays", "config", "metrics"
SAMPLES, LOSS = "num-examples", "loss"


@dataclass(frozen=True)
class LocalWork:
    """What every client of a round is asked to do."""

    round: int  # 1-based within its federation
    steps: int
    learning_rate: float
    seed: int  # of the round; a client adds its own name

    def record(self) -> ConfigRecord:
        """Return the work as the config of a Flower message."""
        return ConfigRecord(dict(vars(self)))

    @classmethod
    def from_record(cls, config: ConfigRecord) -> "LocalWork":
        """Read what `record` wrote."""
        return cls(**{name: config[name] for name in cls.__dataclass_fields__})  # type: ignore[arg-type]


def to_arrays(weights: Weights) -> ArrayRecord:
    """Return weights as a Flower record, in the order they come in."""
    return ArrayRecord({name: Array(np.ascontiguousarray(value)) for name, value in weights.items()})


def to_weights(arrays: ArrayRecord) -> dict[str, np.ndarray]:
    """Return a Flower record as weights."""
    return {name: array.numpy() for name, array in arrays.items()}


def reply(message: Message, update: Update) -> Message:
    """Return the answer to a training message."""
    metrics = MetricRecord({SAMPLES: update.samples, LOSS: update.loss})
    return Message(RecordDict({ARRAYS: to_arrays(update.weights), METRICS: metrics}), reply_to=message)


def to_update(answer: Message) -> LocalUpdate:
    """Read what `reply` wrote."""
    metrics = answer.content.metric_records[METRICS]
    weights = to_weights(answer.content.array_records[ARRAYS])
    return LocalUpdate(weights, int(metrics[SAMPLES]), float(metrics[LOSS]))  # type: ignore[arg-type]
