"""The interface of an aggregation strategy."""

from collections.abc import Sequence
from typing import Protocol

from flcav.federation.trainable import Update, Weights


class Strategy(Protocol):
    """Aggregation of the clients' updates into the weights of the next round.

    A strategy is a frozen dataclass: its fields are its settings, JSON values with defaults. It has no state between
    rounds, so that a resumed federation ends as an uninterrupted one, and it draws no random numbers.
    """

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights at the end of a round that began with `start`, from all clients' updates in node order.

        Names, shapes and types of the arrays must be those of `start`.
        """
        ...
