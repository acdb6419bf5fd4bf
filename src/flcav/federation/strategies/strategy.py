"""What every strategy is."""

from collections.abc import Sequence
from typing import Protocol

from flcav.federation.trainable import Update, Weights


class Strategy(Protocol):
    """How an aggregator makes one network of its clients' updates, round by round.

    A strategy is a frozen dataclass: its fields are its settings, JSON values with defaults. It keeps nothing between
    rounds, so that a resumed federation ends where an uninterrupted one does, and draws no random numbers.
    """

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights that a round from `start` ends with: `updates` are all clients', in node order.

        Names, shapes and types are those of `start`.
        """
        ...
