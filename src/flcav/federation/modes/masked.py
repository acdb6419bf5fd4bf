"""Rounds under secure aggregation, on the server: keys and shares, masked updates, and their unmasked sum."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

import numpy as np
from cryptography import x509
from flwr.app import ConfigRecord, RecordDict

from flcav.federation.acceptance import read_masked
from flcav.federation.exchange import Exchange, Intake, OpenRound
from flcav.federation.secure.messages import SecureSum, TooFewClients
from flcav.federation.secure.parties import settle_complaints
from flcav.federation.secure.primitives import to_values
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.wire import ASK, CONFIG, VECTOR, unflatten

AnswerT = TypeVar("AnswerT")


def collect(exchange: Exchange, round_: OpenRound, authority: x509.Certificate | None = None) -> Intake:
    """Let clients agree on masks, and return the masked updates, of which only the sum is ever unmasked.

    Where shares that one client sealed for another do not open, the round restarts without the liars. Where too few
    clients are left, none is asked to train, and the attendance notes a shortage.

    authority: certificate of the clients' authority; None: their keys are not signed.
    """
    here, secure = round_.here, round_.rules.secure
    assert secure is not None
    if not here.count(round_.rules):
        return Intake()
    local = round_.work.record()
    training = round_.training()
    clients = here.chosen

    def exchange_step(
        asks: Mapping[str, ConfigRecord], read: Callable[[str, RecordDict], AnswerT]
    ) -> dict[str, AnswerT]:
        requests = {name: RecordDict({CONFIG: local, ASK: ask}) for name, ask in asks.items()}
        return dict(exchange.ask(here, requests, read))

    while True:
        needed = secure.needed(len(here.chosen), certified=authority is not None)
        total = SecureSum(exchange_step, needed, round_.work.round, authority)
        try:
            asks = total.agree(clients)
        except TooFewClients as error:
            here.shortage = error
            return Intake()
        updates, complaints = Intake(), dict[str, Sequence[str]]()
        requests = {name: RecordDict({**training, ASK: ask}) for name, ask in asks.items()}
        for name, answer in exchange.ask(here, requests, partial(_read, round_, total), here.chosen):
            if isinstance(answer, LocalUpdate):
                updates.add(name, answer)
            else:
                complaints[name] = answer
        if not complaints:
            updates.average = partial(_unmask, round_, total, updates.updates)
            return updates
        here.failed |= settle_complaints(complaints)
        clients = [name for name in total.peers if name not in here.failed]


def _read(round_: OpenRound, total: SecureSum, name: str, content: RecordDict) -> LocalUpdate | Sequence[str]:
    return read_masked(content, round_.expected, [peer for peer in total.peers if peer != name])


def _unmask(round_: OpenRound, total: SecureSum, updates: Mapping[str, LocalUpdate]) -> Weights:
    """Return start + (sum of the clients' changes) / their number; only the sum is unmasked.

    Raises `TooFewClients`, and `SumLost` where wrong shares make the sum unrecoverable.
    """
    secure = round_.rules.secure
    assert secure is not None
    masked = {name: np.asarray(update.weights[VECTOR], np.uint32) for name, update in updates.items()}
    summed, liars = total.finish(masked)
    round_.here.failed |= liars
    values = to_values(summed, secure.largest, len(total.peers))
    return unflatten(values / len(updates), round_.start, round_.rules)
