"""Rounds of buffered asynchronous aggregation: a round is a buffer, filled by clients in the order of a clock.

The timing of clients does not depend on what they learn. The clock therefore runs first (`flcav.network.clock.buffers`)
and determines the version of the weights that each update starts from; clients then train on those versions. The same
clock and seed give the same bytes.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from flwr.app import RecordDict

from flcav.config import InputError
from flcav.federation.acceptance import Expected, read_update
from flcav.federation.exchange import Attendance, Exchange, Intake, OpenRound
from flcav.federation.links.metered import Account
from flcav.federation.privacy import Privacy, account_epsilon
from flcav.federation.selection import Selection
from flcav.federation.state import UNSENT
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import Arrays, Weights
from flcav.federation.wire import ARRAYS, CONFIG, LocalWork, to_array_record
from flcav.network.ledger import BudgetExceeded, Direction

Work = Callable[[int], LocalWork]  # local training of a round, by its number


@dataclass(frozen=True)
class BrokenUpdate:
    """An update whose transmission was interrupted."""

    client: str
    reason: str  # e.g. "out of coverage"
    down_bytes: int  # transmitted before the interruption
    up_bytes: int


@dataclass(frozen=True)
class FilledBuffer:
    """A round of buffered aggregation: the updates in the buffer, and those interrupted while it was filled."""

    versions: Mapping[str, int]  # version that the update starts from, by client: number of rounds before it
    broken: tuple[BrokenUpdate, ...] = ()


@dataclass(frozen=True)
class Buffers:
    """The buffered rounds of a federation, by a clock, and participations in previous federations."""

    rounds: tuple[FilledBuffer, ...]
    before: Mapping[str, int] = field(default_factory=dict)  # by client

    def participations(self, rounds: int) -> int:
        """Return the most updates that one client began to send, in the first `rounds` rounds and before."""
        times = Counter(self.before)
        for each in self.rounds[:rounds]:
            times.update([*each.versions])
            times.update(broken.client for broken in each.broken if broken.up_bytes)
        return max(times.values(), default=0)

    def epsilon(self, privacy: Privacy, rounds: int) -> float:
        """Return epsilon of the client with most updates, after `rounds` rounds."""
        return account_epsilon(privacy, Selection(), ["one"], self.participations(rounds))

    @property
    def least_before(self) -> int:
        """Return the least number of updates of a client in previous federations; 0 where none is known."""
        return min(self.before.values(), default=0)


def afford_buffers(buffers: Buffers, privacy: Privacy | None) -> int:
    """Return the number of rounds that the privacy budget affords; without a budget all.

    Raises `InputError` where not even one of the first federation is affordable.
    """
    if privacy is None or privacy.epsilon is None or not buffers.rounds:
        return len(buffers.rounds)
    spent = (buffers.epsilon(privacy, number) for number in range(1, len(buffers.rounds) + 1))
    afforded = next((number for number, each in enumerate(spent) if each > privacy.epsilon), len(buffers.rounds))
    if not afforded and not buffers.before:
        epsilon = f"{buffers.epsilon(privacy, 1):.4g} at delta = {privacy.delta:g}"
        raise InputError(
            f"privacy: a first buffer comes to epsilon = {epsilon}, above the budget of {privacy.epsilon:g}"
        )
    return afforded


def fill_in_turns(clients: Sequence[str], size: int, rounds: int) -> Buffers:
    """Return the buffers of clients that are equally fast, and whose messages take no time.

    All training clients finish at the same time and fill buffers in their order; those in a full buffer start again
    from its version. After `rounds` rounds there are further ones, until all clients in training have finished.
    """
    ready: list[tuple[str, int]] = [(name, 0) for name in clients]
    waiting: list[tuple[str, int]] = []
    found = []
    for number in range(rounds + len(clients)):
        while len(waiting) < size:
            waiting.append(ready.pop(0))
        full, waiting = waiting[:size], waiting[size:]
        found.append(FilledBuffer(dict(full)))
        ready += [(name, number + 1) for name, _ in full]
    return Buffers(tuple(found))


def count_participations(records: Sequence[tuple[Sequence[str], Sequence[str]]]) -> dict[str, int]:
    """Return the number of rounds with each client; records: per round, clients that took part and that failed."""
    return dict(Counter(name for clients, failed in records for name in {*clients, *failed}))


@dataclass(frozen=True)
class Buffering:
    """The server's buffered rounds: strategy, rounds of the clock, and ledger."""

    strategy: FedBuff
    buffers: Buffers
    account: Account

    def attend(self, number: int, clients: Sequence[str]) -> Attendance:
        """Return the attendance of a round, in the order of all clients."""
        chosen = [name for name in clients if name in self.buffers.rounds[number - 1].versions]
        return Attendance(chosen, chosen)

    def keep_version(self, number: int, start: Weights, kept: Arrays) -> Arrays:
        """Return the versions that updates from round `number` on start from, out of `start` and those `kept`."""
        needed = {version for later in self.buffers.rounds[number - 1 :] for version in later.versions.values()}
        current = {_key(number - 1, name): np.asarray(array) for name, array in start.items()}
        return {key: array for key, array in (kept | current).items() if int(key.partition("|")[0]) in needed}

    def enter_broken(self, number: int, here: Attendance) -> None:
        """Enter the transmitted parts of interrupted updates in the ledger."""
        for each in self.buffers.rounds[number - 1].broken:
            sizes: tuple[tuple[Direction, int], ...] = (("down", each.down_bytes), ("up", each.up_bytes))
            for direction, size in sizes:
                self.account.ledger.enter(self.account.describe(direction, number, each.client, size))
            if each.client not in here.chosen:  # others succeeded at another attempt
                here.failed[each.client] = each.reason
                here.lost.add(each.client)


def collect(exchange: Exchange, round_: OpenRound, buffering: Buffering, kept: Arrays, work: Work) -> Intake:
    """Return the accepted updates of a round, rebased on its initial weights.

    Clients get the version that they start from, out of those `kept`, and the local `work` of the round that follows
    it. An update that would exceed a budget, and those after it, are not sent, which the round's record reports.
    """
    here = round_.here
    rules = round_.rules
    number = round_.work.round
    strategy = buffering.strategy
    buffer = buffering.buffers.rounds[number - 1]
    begun = {
        version: {name: kept[_key(version, name)] for name in round_.start} for version in buffer.versions.values()
    }
    arrays = {version: to_array_record(weights) for version, weights in begun.items()}
    expected = {version: Expected(rules, weights) for version, weights in begun.items()}
    requests = {}
    for name in here.chosen:
        version = buffer.versions[name]
        # trained as in the round after its version, but answered in this round, once per client
        local = replace(work(version + 1), round=number)
        requests[name] = RecordDict({ARRAYS: arrays[version], CONFIG: local.record()})
    updates = Intake(strategy if rules.privacy is None else None)
    try:
        buffering.enter_broken(number, here)
        read = lambda name, content: read_update(content, expected[buffer.versions[name]])  # noqa: E731
        for name, update in exchange.ask(here, requests, read):
            version = buffer.versions[name]
            updates.add(name, strategy.rebase(round_.start, begun[version], update, number - 1 - version))
    except BudgetExceeded:
        here.spent = True
        for name in here.chosen:
            if name not in updates.samples and name not in here.failed:
                here.failed[name] = UNSENT
                here.lost.add(name)
    return updates


def _key(version: int, name: str) -> str:
    """Return the key in the server's state of an array of a version."""
    return f"{version}|{name}"
