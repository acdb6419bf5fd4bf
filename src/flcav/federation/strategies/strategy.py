"""The interfaces of a strategy: aggregation, and where it has them, state between rounds and a part on the clients."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from flcav.config import InputError
from flcav.federation.trainable import Correction, LocalUpdate, Update, Weights


class Strategy(Protocol):
    """Aggregation of the clients' updates into the weights of the next round.

    A strategy is a frozen dataclass: its fields are its settings, JSON values with defaults. It draws no random
    numbers. State between rounds is handed to it and returned by it (`Stateful`), so that a resumed federation ends as
    an uninterrupted one.
    """

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights at the end of a round that began with `start`, from all clients' updates in node order.

        Names, shapes and types of the arrays must be those of `start`.
        """
        ...


@runtime_checkable
class Stateful(Protocol):
    """A strategy with state between rounds: finite arrays by name, which the server keeps and which are checkpointed.

    Rounds call `step` in place of `combine`, which such a strategy has as well. Keep nothing on `self`: it is in no
    checkpoint, and outlives the federation.
    """

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return what `combine` does, and the state after the round; `state` is empty before the first one.

        `clients` is the number of clients of the federation, whether they take part in the round or not.
        """
        ...


class Averages(Protocol):
    """A strategy that sees no more of the updates than their weighted mean, so that one at a time is in memory.

    It is then given one update: the mean of the weights, and the sums of the samples and of the extra arrays.
    """

    def weigh(self, update: Update) -> float:
        """Return the weight of an update in the mean: finite, not negative."""
        ...


def find_weigher(strategy: Strategy) -> Averages | None:
    """Return the strategy where it `Averages`, None where it needs every update.

    A class that overrides `combine` without `weigh` needs every update.
    """
    owner = next((each for each in type(strategy).__mro__ if "combine" in vars(each)), type(strategy))
    return strategy if "weigh" in vars(owner) else None  # type: ignore[return-value]


@runtime_checkable
class Corrects(Protocol):
    """A strategy whose clients correct the gradients of their local steps."""

    def correct(self, sent: Weights, own: Weights) -> Correction:
        """Return a client's correction in a round, from what the server sent and from the client's own state.

        Both are empty unless the strategy `Exchanges` arrays.
        """
        ...


@runtime_checkable
class Exchanges(Protocol):
    """A strategy that exchanges further arrays beside the weights, and whose clients have state between rounds."""

    def send(self, state: Weights) -> Weights:
        """Return what the server sends to clients beside the weights, from its state."""
        ...

    def report(self, update: LocalUpdate, sent: Weights, own: Weights) -> tuple[Weights, Weights]:
        """Return what a client sends beside its update, and its state after the round; `own` is empty at first.

        The server asks the same of its own weights, with a gradient of zeros: names, shapes and types of the arrays
        that it then gets are those that clients are held to.
        """
        ...


@runtime_checkable
class Robust(Protocol):
    """A strategy that compares the updates with each other, and so needs each of them as it was sent."""

    def check_clients(self, clients: int) -> None:
        """Raise `InputError` where the strategy cannot combine the updates of so few clients."""
        ...


def needs_known_number(strategy: Strategy) -> bool:
    """Return whether the strategy cannot combine the updates of every number of clients."""
    try:
        if isinstance(strategy, Robust):
            strategy.check_clients(1)
    except InputError:
        return True
    return False
