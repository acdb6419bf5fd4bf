"""Aggregation strategies by name: federated averaging, or a user's own."""

from dataclasses import is_dataclass

from flcav.config import InputError
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.strategy import Strategy
from flcav.plugins import load_named

STRATEGIES: dict[str, type[Strategy]] = {"fedavg": FedAvg}
FEDAVG = FedAvg()  # the default everywhere


def strategy_named(name: str) -> Strategy:
    """Return the strategy of that name with its default settings: one of `STRATEGIES`, or a user's own, `module:NAME`.

    Raises `InputError` for an unknown name, where the user's module cannot be imported or has no strategy of that name,
    and where the strategy is no dataclass.
    """
    found: Strategy = load_named("strategy", name, STRATEGIES, Strategy)
    if not is_dataclass(found):
        raise InputError(f"strategy '{name}': is no dataclass, so that its settings are not known")
    return found
