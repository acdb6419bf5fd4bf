"""How an aggregator combines updates."""

from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.strategy import Strategy

STRATEGIES: dict[str, type[Strategy]] = {"fedavg": FedAvg}
FEDAVG = FedAvg()  # the default everywhere
