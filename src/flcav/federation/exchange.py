"""The server's exchange of messages with the clients of a round: who takes part, requests, answers, usable updates."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from flwr.app import Message, MessageType, RecordDict
from flwr.serverapp import Grid
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.federation import wire
from flcav.federation.acceptance import Expected, NoSamples, NotFinite, ReplyRefused
from flcav.federation.rules import Rules
from flcav.federation.secure.messages import TooFewClients
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import NoShares, RunningMean
from flcav.federation.strategies.strategy import Averages, Robust
from flcav.federation.trainable import LocalUpdate, Weights, learned_names

AnswerT = TypeVar("AnswerT")


class ClientFailed(OSError):
    """Fewer clients sent a usable update in a round than are wanted: a fault of their machines."""

    reached: Weights | None = None  # after the last round that came to an end; of `federate`


class Diverged(ClientFailed):
    """All clients that failed sent an update that is not finite, so that too few are left."""


@dataclass
class Attendance:
    """Attendance of a round: the clients that are asked, and those of them without an update, with the reason."""

    asked: list[str] = field(default_factory=list)  # for anything
    chosen: list[str] = field(default_factory=list)  # to send an update, also those that are away
    away: Mapping[str, str] = field(default_factory=dict)  # clients that are not there at first, with the reason
    failed: dict[str, str] = field(default_factory=dict)  # by client what was wrong
    lost: set[str] = field(default_factory=set)  # those of them whom the network lost
    diverged: set[str] = field(default_factory=set)  # those of them whose update is not finite
    idle: set[str] = field(default_factory=set)  # those of them without samples, or with no weight for the strategy
    shortage: ClientFailed | TooFewClients | None = None  # why there is no update
    few: bool = False  # whether fewer take part than the rules need
    spent: bool = False  # whether a budget kept some from sending, in the last round of buffers

    def note(self, event: wire.Lost | wire.TimedOut) -> None:
        """Note a client that is lost, or has not answered: the latter with the reason of an earlier failure, if any."""
        if isinstance(event, wire.TimedOut):
            self.failed.setdefault(event.client, "no answer")
        else:
            self.failed[event.client] = event.reason
            self.lost |= {event.client} if event.by_network else set()

    def excuse(self, error: Exception) -> None:
        """Note why the round has no update; raises `TooFewClients` where clients failed and nothing else is why."""
        if isinstance(error, TooFewClients) and not (self.lost or self.few or self.idle):
            raise error
        without = {name: str(error) for name in self.chosen if name not in self.failed}
        self.failed |= without
        self.idle |= without.keys() if isinstance(error, NoShares) else set()

    def count(self, rules: Rules) -> bool:
        """Return whether enough take part for the rules; note it where, by a plan, by chance or since some are away,
        they are too few.
        """
        chosen, secure = len(self.chosen), rules.secure
        absent = {name: self.away[name] for name in self.chosen if name in self.away}
        if short := rules.tell_shortage(chosen - len(absent)):
            self.shortage = ClientFailed(short)
            self.failed |= absent
            self.lost |= absent.keys()
        self.few = bool(short) or (secure is not None and secure.needed(chosen) > chosen)
        return not short

    def check(self, rules: Rules, strategy: Strategy, number: int) -> None:
        """Raise `ClientFailed` where in round `number` fewer sent what can be used than are wanted.

        By default half of those are wanted who were asked, and whom the network did not lose: of all who were to report
        a norm or a number of samples, and of those who were then to send an update. `all` is of both, too, a number of
        those who were to send; who was away or has no samples does not count. Where fewer are left than `strategy`
        needs, the round has no update, and so where fewer take part than the rules need, unless a client failed, or
        where fewer are left than a number of the rules since some have no samples.
        """
        if self.spent:
            return
        reasons = "; ".join(f"{name}: {reason}" for name, reason in self.failed.items())
        if self.few:
            if self.failed.keys() - self.lost - self.idle:
                raise ClientFailed(f"round {number}: {self.shortage} ({reasons})")
            return
        least = rules.least_clients
        for clients in [self.chosen] if isinstance(least, int) else [self.asked, self.chosen]:
            excused = self.idle | (self.lost if least is None else self.away.keys())
            asked = [name for name in clients if name not in excused]
            wanted = len(asked) if least == "all" else -(-len(asked) // 2) if least is None else least
            usable = sum(name not in self.failed for name in asked)
            if usable < wanted:
                told = f"{usable} of {len(asked)} clients sent an update that can be used, {wanted} are wanted"
                if isinstance(least, int) and usable + len(self.idle.intersection(clients)) >= wanted:
                    self.shortage = ClientFailed(told)
                    continue
                kind = Diverged if self.failed.keys() - self.lost - self.idle <= self.diverged else ClientFailed
                raise kind(f"round {number}: {told} ({reasons})")
        if isinstance(strategy, Robust):
            try:
                strategy.check_clients(sum(name not in self.failed for name in self.chosen))
            except InputError as error:
                self.shortage = ClientFailed(str(error))  # a minority that sends rubbish does not end a federation


class Intake:
    """The usable updates of a round: all of them or, where a strategy needs no more, their mean as they come in."""

    def __init__(self, weigher: Averages | None = None) -> None:
        """Add up by the weights of `weigher`; None: keep every update."""
        self._weigher, self._mean = weigher, RunningMean()
        self._extra: dict[str, NDArray[np.number]] = {}  # sums of the arrays beside the weights
        self.updates: dict[str, LocalUpdate] = {}  # by client, where they are kept
        self.samples: dict[str, int] = {}  # by client
        self.losses: dict[str, float] = {}  # by client
        self.average: Callable[[], Weights] | None = None  # weights after the round, where a mode averages by itself

    def add(self, client: str, update: LocalUpdate) -> None:
        """Add a client's update."""
        self.samples[client], self.losses[client] = update.samples, update.loss
        if self._weigher is None:
            self.updates[client] = update
            return
        self._mean.add(update.weights, self._weigher.weigh(update))
        for name, array in update.extra.items():
            self._extra[name] = self._extra.get(name, 0.0) + array.astype(np.float64)

    @property
    def combinable(self) -> list[LocalUpdate]:
        """Return what a strategy is given: all updates, or one that stands for them; none where none came."""
        if self._weigher is None or not self.samples:
            return [*self.updates.values()]
        return [LocalUpdate(self._mean.mean(), sum(self.samples.values()), 0.0, extra=self._extra)]

    def mean_loss(self) -> float | None:
        """Return the mean loss weighted by samples; None where no update came."""
        return float(np.average([*self.losses.values()], weights=[*self.samples.values()])) if self.samples else None


@dataclass
class OpenRound:
    """A round under way: its local work, who takes part, what is sent, and what updates must look like."""

    work: wire.LocalWork
    here: Attendance
    expected: Expected  # of the updates, with the rules and the weights that the round began with
    sent: Weights = field(default_factory=dict)  # a strategy's arrays that go with the weights
    centre: Weights | None = None  # that clients are pulled to

    @property
    def start(self) -> Weights:
        """Return the weights that the round began with."""
        return self.expected.start

    @property
    def rules(self) -> Rules:
        """Return the rules of the round."""
        return self.expected.rules

    def training(self) -> RecordDict:
        """Return a request to train: weights, what goes with them, and the local work."""
        records = {wire.ARRAYS: wire.to_array_record(self.start)} | (
            {wire.EXTRA: wire.to_array_record(self.sent)} if self.sent else {}
        )
        if self.centre is not None:
            records[wire.CENTRE] = wire.to_array_record(
                {name: self.centre[name] for name in learned_names(self.centre)}
            )
        return RecordDict({**records, wire.CONFIG: self.work.record()})


@dataclass(frozen=True)
class Exchange:
    """The server's end of the exchange: a Flower grid, whose nodes are the clients."""

    grid: Grid
    names: Mapping[int, str]  # of the clients, by node

    def ask(
        self,
        here: Attendance,
        requests: Mapping[str, RecordDict],
        read: Callable[[str, RecordDict], AnswerT],
        awaited: Sequence[str] | None = None,
    ) -> Iterator[tuple[str, AnswerT]]:
        """Send each client its request, and yield by client, in their order, what `read` makes of its reply.

        Clients that are lost, do not answer or whose reply is refused are noted `here`, with the reason. `awaited`: who
        is to answer, where that is more than are sent a request.
        """
        nodes = {name: node for node, name in self.names.items()}
        messages = (Message(content, nodes[name], MessageType.TRAIN) for name, content in requests.items())
        replies = self.grid.send_and_receive(messages, timeout=wire.ANSWER_S)
        for event in wire.list_events(requests if awaited is None else awaited, replies, self.names):
            if not isinstance(event, wire.Arrived):
                here.note(event)
                continue
            try:
                answer = read(event.client, event.content)
            except ReplyRefused as error:
                here.failed[event.client] = str(error)
                here.idle |= {event.client} if isinstance(error, NoSamples) else set()
                here.diverged |= {event.client} if isinstance(error, NotFinite) else set()
            else:
                yield event.client, answer
