"""The interfaces of a strategy: aggregation and, optionally, state between rounds and a part on the clients."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from flcav.config import InputError
from flcav.federation.trainable import Correction, LocalUpdate, Update, Weights


class Strategy(Protocol):
    """Aggregation of the clients' updates into the weights of the next round.

    A strategy is a frozen dataclass: its fields are its settings, JSON values with defaults. It draws no random
    numbers. State between rounds is passed to it and returned by it (`Stateful`), so that a resumed federation ends
    with the same weights as an uninterrupted one.
    """

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights after a round that started from `start`, given all updates in node order.

        Names, shapes and types of the arrays must be those of `start`.
        """
        ...


@runtime_checkable
class Stateful(Protocol):
    """A strategy with state between rounds: finite arrays by name, which the server keeps and which are checkpointed.

    Rounds call `step` in place of `combine`, which such a strategy has as well. Store nothing on `self`: it is in no
    checkpoint, and outlives the federation.
    """

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return the weights as `combine` does, and the state after the round; `state` is empty before the first one.

        `clients` is the number of all clients of the federation, including those not in this round.
        """
        ...


class Averages(Protocol):
    """A strategy that needs only the weighted mean of the updates, so that a single one is in memory at a time.

    It then receives one update: the mean of the weights, and the sums of the samples and of the further arrays.
    """

    def weigh(self, update: Update) -> float:
        """Return the weight of an update in the mean: finite, not negative."""
        ...


def find_weigher(strategy: Strategy) -> Averages | None:
    """Return the strategy if it is one of `Averages`, None if it needs every update.

    A class that overrides `combine` without `weigh` needs every update.
    """
    owner = next((each for each in type(strategy).__mro__ if "combine" in vars(each)), type(strategy))
    return strategy if "weigh" in vars(owner) else None  # type: ignore[return-value]


@runtime_checkable
class Corrects(Protocol):
    """A strategy whose clients correct the gradients of their local steps."""

    def correct(self, sent: Weights, own: Weights) -> Correction:
        """Return a client's correction in a round, given the server's further arrays `sent` and the client's state.

        Both are empty unless the strategy is one of `Exchanges`.
        """
        ...


@runtime_checkable
class Exchanges(Protocol):
    """A strategy that exchanges arrays in addition to the weights, and whose clients have state between rounds."""

    def send(self, state: Weights) -> Weights:
        """Return the arrays that the server sends in addition to the weights, from its state."""
        ...

    def report(self, update: LocalUpdate, sent: Weights, own: Weights) -> tuple[Weights, Weights]:
        """Return a client's arrays in addition to its update, and its state after the round; `own` is empty at first.

        The server calls it for its weights with a gradient of zeros, too, to know the names, shapes and dtypes that it
        then requires of all clients.
        """
        ...


@runtime_checkable
class Robust(Protocol):
    """A strategy that compares the updates with each other, and therefore needs all of them unaltered."""

    def check_clients(self, clients: int) -> None:
        """Raise `InputError` where the strategy cannot combine the updates of so few clients."""
        ...


def needs_known_number(strategy: Strategy) -> bool:
    """Return whether the strategy cannot combine the updates of an arbitrary number of clients."""
    try:
        if isinstance(strategy, Robust):
            strategy.check_clients(1)
    except InputError:
        return True
    return False
