"""A client's guard against a dishonest server: it answers every round once, in the agreed order, within its budget.

A server that could repeat or reorder requests might average noise away, see an update without its masks, or subtract
two messages about the same change. A client therefore stores the last request in its state before the answer leaves;
no message of the server changes that record.
"""

import hashlib
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from flwr.app import Array, ArrayRecord, Context, RecordDict

from flcav.federation import wire
from flcav.federation.privacy import Privacy, affordable_rounds
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection

ANSWERED = "answered"  # record of a node's state
UPDATE = "update"  # the default request
NOTHING = bytes(32)  # digest before the first request
MOST_ROUNDS = 10**6  # upper end of the search for the rounds that a budget affords


class RequestRefused(ValueError):
    """A request that a client must not answer."""


def agreed_requests(rules: Rules) -> tuple[str, ...]:
    """Return the kinds of requests in a round, in order."""
    if rules.secure is not None:
        return wire.KEYS, wire.SHARES, wire.MASKED, wire.UNMASK
    if rules.selection.rule == "importance":
        return wire.NORM, wire.SEND
    return (wire.COUNT, UPDATE) if rules.selection.unbiased else (UPDATE,)


@dataclass(frozen=True)
class Answered:
    """The last request that a client answered."""

    round: int = 0
    place: int = 0  # index of the request among the agreed ones
    rounds: int = 0  # number of rounds answered so far
    digest: bytes = NOTHING  # of the request; under secure aggregation, of the request to train in this round

    def admit(self, round_: int, asked: str, digest: bytes, rules: Rules, repeatable: bool) -> "Answered":
        """Return the new last answered request if `asked` is admissible in a round; raises `RequestRefused`.

        A request may be repeated, as after a restart of the server, if the same answer can be given (`repeatable`).
        Under secure aggregation a round may restart with new masks until its sum is unmasked; the masked update stays
        that of the first request to train, identified by its `digest`.
        """
        requests = agreed_requests(rules)
        masked = rules.secure is not None
        if asked not in requests:
            raise RequestRefused(f"a request for '{asked}', and agreed are {', '.join(requests)}")
        place = requests.index(asked)
        if round_ > self.round and place == 0:
            return Answered(round_, place, self.rounds + 1, NOTHING if masked else digest)
        if 0 < round_ == self.round:
            again = masked and place == 0 and requests[self.place] != wire.UNMASK
            if place == self.place + 1 or again:
                if asked == wire.MASKED and self.digest not in (NOTHING, digest):
                    raise RequestRefused(f"another training of round {round_} than that whose update was masked")
                trained = self.digest if masked and asked != wire.MASKED else digest
                return Answered(round_, place, self.rounds, trained)
            if place == self.place and digest == self.digest and repeatable:
                return self
        last = f"{requests[self.place]} of round {self.round}" if self.rounds else "nothing"
        raise RequestRefused(f"a request for {asked} of round {round_}, after {last} was answered")


def recall_answered(context: Context) -> Answered:
    """Return the last request that a node answered."""
    if ANSWERED not in context.state:
        return Answered()
    kept = wire.read_arrays(context.state, ANSWERED)[ANSWERED]
    round_, place, rounds = kept[:3].tolist()
    return Answered(round_, place, rounds, kept[3:].tobytes())


def keep_answered(context: Context, answered: Answered) -> None:
    """Store the last request that a node answers."""
    numbers = np.array([answered.round, answered.place, answered.rounds], np.int64)
    context.state[ANSWERED] = wire.to_array_record(
        {ANSWERED: np.concatenate([numbers, np.frombuffer(answered.digest, np.int64)])}
    )


class RequestDigests:
    """Digests of requests, and the number of rounds that a budget affords, for the clients of a process.

    Their requests share arrays, which are hashed once.
    """

    def __init__(self, privacy: Privacy | None) -> None:
        """Take the budget of `privacy`."""
        self._privacy = privacy
        self._last: Mapping[str, tuple[list[bytes], bytes]] = {}  # by record: its data and their digest
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type["RequestDigests"], tuple[Privacy | None]]:
        """Return the constructor for another process: the cached digests only save time."""
        return RequestDigests, (self._privacy,)

    @cached_property
    def affordable(self) -> int | None:
        """Number of rounds that a client's budget affords, see `affordable_answers`."""
        return affordable_answers(self._privacy)

    def digest(self, content: RecordDict, without: str = wire.LOST) -> bytes:
        """Return the digest (32 bytes, BLAKE2b) of a request, without its note that the answer will be lost.

        without: another record to leave out.
        """
        hashed = hashlib.blake2b(digest_size=32)
        with self._lock:
            for key, record in sorted(content.items()):
                if key not in (wire.LOST, without):
                    hashed.update(f"{key!r} ".encode())
                    hashed.update(
                        self._digest_arrays(key, [*record.items()])
                        if isinstance(record, ArrayRecord)
                        else repr(sorted(record.items())).encode()
                    )
        return hashed.digest()

    def _digest_arrays(self, key: str, arrays: list[tuple[str, Array]]) -> bytes:
        data = [array.data for _, array in arrays]
        before, digest = self._last.get(key, ([], b""))
        if len(before) != len(data) or any(one is not other for one, other in zip(before, data, strict=True)):
            hashed = hashlib.blake2b(digest_size=32)
            for name, array in arrays:
                hashed.update(f"{name!r} {array.dtype} {array.shape} {len(array.data)} ".encode())
                hashed.update(array.data)
            digest = hashed.digest()
            self._last = {**self._last, key: (data, digest)}
        return digest


def affordable_answers(privacy: Privacy | None) -> int | None:
    """Return the number of rounds that a client's budget affords with local noise; None: no limit."""
    if privacy is None or not privacy.local or privacy.epsilon is None:
        return None
    return affordable_rounds(privacy, Selection(), ["one"], MOST_ROUNDS, 0)


def asked_for(content: RecordDict) -> str:
    """Return the kind of a request."""
    return str(content.config_records[wire.ASK][wire.ASK]) if wire.ASK in content else UPDATE
