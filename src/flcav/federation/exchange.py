"""The server's exchange of messages in a round: attendance of clients, requests, replies, and accepted updates."""

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
    """Too few clients sent a usable update in a round, since their machines failed."""

    reached: Weights | None = None  # weights after the last completed round; set by `federate`


class Diverged(ClientFailed):
    """All clients that failed sent an update that is not finite, so that too few are left."""


@dataclass
class Attendance:
    """The attendance of a round: its clients, and those of them without an update, with the reason."""

    asked: list[str] = field(default_factory=list)  # clients that get any request
    chosen: list[str] = field(default_factory=list)  # clients that should send an update, also those that are absent
    away: Mapping[str, str] = field(default_factory=dict)  # clients absent at the start, with the reason
    failed: dict[str, str] = field(default_factory=dict)  # reason by client
    lost: set[str] = field(default_factory=set)  # failed clients that the network lost
    diverged: set[str] = field(default_factory=set)  # failed clients whose update is not finite
    idle: set[str] = field(default_factory=set)  # failed clients without samples, or without weight in the strategy
    shortage: ClientFailed | TooFewClients | None = None  # why the round has no update
    few: bool = False  # whether fewer clients take part than the rules need
    spent: bool = False  # whether a budget kept clients from sending, in the last buffered round

    def note(self, event: wire.Lost | wire.TimedOut) -> None:
        """Note a lost client, or one without an answer, which keeps the reason of an earlier failure."""
        if isinstance(event, wire.TimedOut):
            self.failed.setdefault(event.client, "no answer")
        else:
            self.failed[event.client] = event.reason
            self.lost |= {event.client} if event.by_network else set()

    def excuse(self, error: Exception) -> None:
        """Note why the round has no update; raises `TooFewClients` where only failures of clients explain it."""
        if isinstance(error, TooFewClients) and not (self.lost or self.few or self.idle):
            raise error
        without = {name: str(error) for name in self.chosen if name not in self.failed}
        self.failed |= without
        self.idle |= without.keys() if isinstance(error, NoShares) else set()

    def count(self, rules: Rules) -> bool:
        """Return whether enough clients take part for the rules; note it where there are too few.

        Too few may be planned, drawn, or present.
        """
        chosen = len(self.chosen)
        secure = rules.secure
        absent = {name: self.away[name] for name in self.chosen if name in self.away}
        if short := rules.tell_shortage(chosen - len(absent)):
            self.shortage = ClientFailed(short)
            self.failed |= absent
            self.lost |= absent.keys()
        self.few = bool(short) or (secure is not None and secure.needed(chosen) > chosen)
        return not short

    def check(self, rules: Rules, strategy: Strategy, number: int) -> None:
        """Raise `ClientFailed` where too few clients sent usable answers in round `number`.

        By default half of the asked clients are needed, without those that the network lost: half of all that had to
        report a norm or a number of samples, and half of those that then had to send an update. `all` refers to both
        steps, a number only to the second; clients that are absent or have no samples do not count. The round has no
        update, and nothing is raised, where fewer clients are left than `strategy` needs, where fewer take part than
        the rules need and none failed, or where a number of the rules is missed because of clients without samples.
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
                few = f"{usable} of {len(asked)} clients sent an update that can be used, {wanted} are wanted"
                if isinstance(least, int) and usable + len(self.idle.intersection(clients)) >= wanted:
                    self.shortage = ClientFailed(few)
                    continue
                kind = Diverged if self.failed.keys() - self.lost - self.idle <= self.diverged else ClientFailed
                raise kind(f"round {number}: {few} ({reasons})")
        if isinstance(strategy, Robust):
            try:
                strategy.check_clients(sum(name not in self.failed for name in self.chosen))
            except InputError as error:
                self.shortage = ClientFailed(str(error))  # a minority of invalid updates must not end a federation


class Intake:
    """The accepted updates of a round: all of them or, where that is enough for the strategy, their running mean."""

    def __init__(self, weigher: Averages | None = None) -> None:
        """Average with the weights of `weigher`; None: keep every update."""
        self._weigher = weigher
        self._mean = RunningMean()
        self._extra: dict[str, NDArray[np.number]] = {}  # sums of the strategy's further arrays
        self.updates: dict[str, LocalUpdate] = {}  # by client, where they are kept
        self.samples: dict[str, int] = {}  # by client
        self.losses: dict[str, float] = {}  # by client
        self.average: Callable[[], Weights] | None = None  # weights after the round, where the mode averages

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
        """Return the updates for a strategy: all, or their mean as a single one; none where none came."""
        if self._weigher is None or not self.samples:
            return [*self.updates.values()]
        return [LocalUpdate(self._mean.mean(), sum(self.samples.values()), 0.0, extra=self._extra)]

    def mean_loss(self) -> float | None:
        """Return the mean loss, weighted by samples; None where no update came."""
        return float(np.average([*self.losses.values()], weights=[*self.samples.values()])) if self.samples else None


@dataclass
class OpenRound:
    """A round in progress: its local work, attendance, downlink, and the expected form of its updates."""

    work: wire.LocalWork
    here: Attendance
    expected: Expected  # of the updates, with the rules and the weights that the round began with
    sent: Weights = field(default_factory=dict)  # the strategy's further arrays
    centre: Weights | None = None  # centre of the proximal term
    model: Weights | None = None  # `start` as it is sent down; None: whole

    @property
    def start(self) -> Weights:
        """Return the weights at the start of the round."""
        return self.expected.start

    @property
    def rules(self) -> Rules:
        """Return the rules of the round."""
        return self.expected.rules

    def training(self) -> RecordDict:
        """Return a request to train: weights, further arrays, and the local work."""
        records = {wire.ARRAYS: wire.to_array_record(self.start if self.model is None else self.model)} | (
            {wire.EXTRA: wire.to_array_record(self.sent)} if self.sent else {}
        )
        if self.centre is not None:
            records[wire.CENTRE] = wire.to_array_record(
                {name: self.centre[name] for name in learned_names(self.centre)}
            )
        return RecordDict({**records, wire.CONFIG: self.work.record()})


@dataclass(frozen=True)
class Exchange:
    """The server's end of the exchange: a Flower grid whose nodes are the clients."""

    grid: Grid
    names: Mapping[int, str]  # of the clients, by node

    def ask(
        self,
        here: Attendance,
        requests: Mapping[str, RecordDict],
        read: Callable[[str, RecordDict], AnswerT],
        awaited: Sequence[str] | None = None,
    ) -> Iterator[tuple[str, AnswerT]]:
        """Send the clients their requests, and yield client and `read` reply in the order of the clients.

        Clients that are lost, do not answer or send an invalid reply are noted in `here`, with the reason. `awaited`:
        the clients that have to answer, where these are more than the requests.
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
