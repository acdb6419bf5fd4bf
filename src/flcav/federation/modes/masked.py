"""Secure aggregation of a round, as the server conducts it: keys and shares, masked updates, the sum of these."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from cryptography import x509
from flwr.app import ConfigRecord, RecordDict

from flcav.federation.acceptance import Expected, read_masked
from flcav.federation.exchange import Attendance, Intake
from flcav.federation.rules import SecureAggregation
from flcav.federation.secure.messages import SecureSum, TooFewClients
from flcav.federation.secure.parties import settle_complaints
from flcav.federation.secure.primitives import to_values
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.wire import ASK, CONFIG, VECTOR, unflatten

AnswerT = TypeVar("AnswerT")


class Ask(Protocol):
    """The server's exchange with clients: requests out, answers in, failures noted."""

    def __call__(
        self,
        here: Attendance,
        requests: Mapping[str, RecordDict],
        read: Callable[[str, RecordDict], AnswerT],
        awaited: list[str] | None = None,
    ) -> Iterator[tuple[str, AnswerT]]:
        """Yield what `read` makes of each client's answer."""
        ...


@dataclass
class SecureRound:
    """Secure aggregation of one round: the server learns the sum of the clients' changes alone."""

    how: SecureAggregation
    expected: Expected  # of the updates
    here: Attendance
    round: int
    records: Mapping[str, Any]  # of the training message, the round's local work among them
    ask: Ask
    authority: x509.Certificate | None = None  # that has certified the clients; None: their keys are not signed
    total: SecureSum | None = None  # under the masks that were agreed last

    def collect(self) -> Intake:
        """Agree on masks, and return the masked updates.

        Where shares that one client sealed for another do not open, the round begins again without the liars. Where too
        few are left, nobody is asked to train, and the attendance has a shortage.
        """
        clients = self.here.chosen
        while True:
            needed = self.how.needed(len(self.here.chosen), certified=self.authority is not None)
            self.total = SecureSum(self._exchange, needed, self.round, self.authority)
            try:
                asks = self.total.agree(clients)
            except TooFewClients as error:
                self.here.shortage = error
                return Intake()
            received, complaints = Intake(), dict[str, Sequence[str]]()
            requests = {name: RecordDict({**self.records, ASK: ask}) for name, ask in asks.items()}
            for name, answer in self.ask(self.here, requests, self._read, self.here.chosen):
                if isinstance(answer, LocalUpdate):
                    received.add(name, answer)
                else:
                    complaints[name] = answer
            if not complaints:
                return received
            self.here.failed |= settle_complaints(complaints)
            clients = [name for name in self.total.peers if name not in self.here.failed]

    def average(self, updates: Mapping[str, LocalUpdate]) -> Weights:
        """Return start + (sum of the clients' changes) / their number; the sum is all that is unmasked.

        Raises `TooFewClients`, and `SumLost` where wrong shares leave no way to the sum.
        """
        assert self.total is not None
        masked = {name: np.asarray(update.weights[VECTOR], np.uint32) for name, update in updates.items()}
        summed, liars = self.total.finish(masked)
        self.here.failed |= liars
        total = to_values(summed, self.how.largest, len(self.total.peers))
        return unflatten(total / len(updates), self.expected.start, self.expected.rules)

    def _exchange(
        self, asks: Mapping[str, ConfigRecord], read: Callable[[str, RecordDict], AnswerT]
    ) -> dict[str, AnswerT]:
        local = self.records[CONFIG]
        requests = {name: RecordDict({CONFIG: local, ASK: ask}) for name, ask in asks.items()}
        return dict(self.ask(self.here, requests, read))

    def _read(self, name: str, content: RecordDict) -> LocalUpdate | Sequence[str]:
        assert self.total is not None
        return read_masked(content, self.expected, [peer for peer in self.total.peers if peer != name])
