"""Conduct of a client: it answers each round once, in order, in the way that was agreed, and within its budget.

A server that asks otherwise could average noise away, see an update without its masks, or the same change from two
sides. A client keeps what it answered last among its state, before the answer leaves; nothing that the server sends
changes it.
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
UPDATE = "update"  # asked for where nothing else is
NOTHING = bytes(32)  # in the place of a digest, before the first request
MOST_ROUNDS = 10**6  # that a budget is looked up for


class RequestRefused(ValueError):
    """A request that a client does not answer."""


def agreed_requests(rules: Rules) -> tuple[str, ...]:
    """Return what clients are asked for in a round, in this order."""
    if rules.secure is not None:
        return wire.KEYS, wire.SHARES, wire.MASKED, wire.UNMASK
    if rules.selection.rule == "importance":
        return wire.NORM, wire.SEND
    return (wire.COUNT, UPDATE) if rules.selection.unbiased else (UPDATE,)


@dataclass(frozen=True)
class Answered:
    """The last request that a client answered."""

    round: int = 0
    place: int = 0  # of the request among those that are agreed on
    rounds: int = 0  # in which it has answered so far
    digest: bytes = NOTHING  # of the request; under secure aggregation of the training that the round's update is of

    def admit(self, round_: int, asked: str, digest: bytes, rules: Rules, repeatable: bool) -> "Answered":
        """Return what is answered last after a request for `asked` in a round; raises `RequestRefused`.

        The same request may come again, as after a stop of the server, where the same answer can be given:
        `repeatable`. Under secure aggregation a round may restart, with new masks, until its sum is unmasked; what they
        hide stays the update of the first training that was asked for, by its `digest`.
        """
        requests, masked = agreed_requests(rules), rules.secure is not None
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
        told = f"{requests[self.place]} of round {self.round}" if self.rounds else "nothing"
        raise RequestRefused(f"a request for {asked} of round {round_}, after {told} was answered")


def recall_answered(context: Context) -> Answered:
    """Return what a node has answered last."""
    if ANSWERED not in context.state:
        return Answered()
    kept = wire.read_arrays(context.state, ANSWERED)[ANSWERED]
    round_, place, rounds = kept[:3].tolist()
    return Answered(round_, place, rounds, kept[3:].tobytes())


def keep_answered(context: Context, answered: Answered) -> None:
    """Keep what a node answers."""
    numbers = np.array([answered.round, answered.place, answered.rounds], np.int64)
    context.state[ANSWERED] = wire.to_array_record(
        {ANSWERED: np.concatenate([numbers, np.frombuffer(answered.digest, np.int64)])}
    )


class RequestDigests:
    """Requests as the clients of a process see them: in how many rounds they answer, and digests of what is asked.

    The clients share the arrays of theirs, which are hashed once.
    """

    def __init__(self, privacy: Privacy | None) -> None:
        """Answer within the budget of `privacy`."""
        self._privacy = privacy
        self._last: Mapping[str, tuple[list[bytes], bytes]] = {}  # by record: its data and their digest
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type["RequestDigests"], tuple[Privacy | None]]:
        """Return how another process makes its own: what is kept here is only for speed."""
        return RequestDigests, (self._privacy,)

    @cached_property
    def affordable(self) -> int | None:
        """Number of rounds in which a client's budget affords an answer, see `affordable_answers`."""
        return affordable_answers(self._privacy)

    def digest(self, content: RecordDict, without: str = wire.LOST) -> bytes:
        """Return the digest of all that is asked, which is 32 bytes (BLAKE2b); not of the note that nothing arrives.

        without: another record that does not count.
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
    """Return in how many rounds a client's own budget affords an answer with its noise; None: in any number."""
    if privacy is None or not privacy.local or privacy.epsilon is None:
        return None
    return affordable_rounds(privacy, Selection(), ["one"], MOST_ROUNDS, 0)


def asked_for(content: RecordDict) -> str:
    """Return what a request asks for."""
    return str(content.config_records[wire.ASK][wire.ASK]) if wire.ASK in content else UPDATE
