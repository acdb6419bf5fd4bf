"""Clients of a federation, vehicles with their samples, and the strategies and rules of it in words."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flcav.federation.rules import Rules
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Weights
from flcav.perception.client import TaskClient
from flcav.perception.distillation import OutputClient, SharedSamples
from flcav.pipeline.learning import Learning


@dataclass(frozen=True)
class Strategies:
    """Strategies of stage III: of edge servers with their vehicles, and of the cloud with edge servers."""

    edge: Strategy
    cloud: Strategy


def make_clients(learning: Learning, config: Any, samples: Mapping[str, Sequence[Any]]) -> dict[str, TaskClient]:
    """Return a federation's clients by vehicle; vehicles without samples are left out."""
    return {
        name: TaskClient(learning.task, config, samples[name], batch=learning.batch)
        for name in sorted(samples)
        if len(samples[name])
    }


def give_outputs(clients: Mapping[str, TaskClient], shared: SharedSamples, start: Weights) -> dict[str, OutputClient]:
    """Return clients that send outputs on `shared` samples, and begin with a network of the weights `start`."""
    return {name: OutputClient(client, shared, start) for name, client in clients.items()}


def describe_federation(strategy: Strategy | Strategies, rules: Rules) -> str:
    """Return strategies and rules, as far as they are not the defaults, in words: what a checkpoint is of."""
    changed = rules.model_dump(mode="json", include=set(Rules.model_fields), exclude_defaults=True)
    return f"{strategy} by {json.dumps(changed)}" if changed else str(strategy)
