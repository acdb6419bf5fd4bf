"""Federated learning over a vehicle-edge-cloud network: rounds, aggregation strategies, metered messages."""

import os
from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

os.environ.setdefault("FLWR_TELEMETRY_ENABLED", "0")  # read when Flower is imported

if TYPE_CHECKING:
    from flcav.federation.links.metered import Account
    from flcav.federation.loop import Schedule, federate
    from flcav.federation.privacy import Privacy
    from flcav.federation.rules import Rules
    from flcav.federation.selection import Selection
    from flcav.federation.state import FederationState, RoundRecord
    from flcav.federation.strategies import STRATEGIES, FedAvg, Strategy, strategy_named
    from flcav.federation.strategies.fedavg import average
    from flcav.federation.trainable import LocalUpdate, Trainable, Update
    from flcav.federation.upload import Upload

PLACES = {
    "Account": "flcav.federation.links.metered",
    "Privacy": "flcav.federation.privacy",
    "Rules": "flcav.federation.rules",
    "Selection": "flcav.federation.selection",
    "Upload": "flcav.federation.upload",
    "FederationState": "flcav.federation.state",
    "RoundRecord": "flcav.federation.state",
    "Schedule": "flcav.federation.loop",
    "federate": "flcav.federation.loop",
    "STRATEGIES": "flcav.federation.strategies",
    "FedAvg": "flcav.federation.strategies",
    "Strategy": "flcav.federation.strategies",
    "average": "flcav.federation.strategies.fedavg",
    "strategy_named": "flcav.federation.strategies",
    "LocalUpdate": "flcav.federation.trainable",
    "Trainable": "flcav.federation.trainable",
    "Update": "flcav.federation.trainable",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
