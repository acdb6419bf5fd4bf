"""Rounds of an ad hoc group: one of its vehicles leads; if it leaves, even in mid-round, the next one takes over.

The lead is the server of the group's rounds; its update crosses no link. A lead that leaves in mid-round takes the
received updates with it. The remaining members have the weights that the round began with, so the next lead begins the
round again: it asks for the received updates once more, and the weights are those of a round that it led from the
start. The server state that a strategy keeps between rounds, such as moments, is lost with the lead.
"""

from collections.abc import Sequence
from dataclasses import replace

from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import OnRound
from flcav.federation.state import FederationState
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.clock.records import RoundTiming
from flcav.network.clock.rounds import LEFT_TOWN, NO_COVERAGE
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.runs.extras.groups.rows import LeadTerm
from flcav.runs.stages.rounds import RunRounds

LEAVES = (LEFT_TOWN, NO_COVERAGE)  # reasons for the loss of a vehicle that end its lead


class LeadLeft(Exception):
    """Raised when the vehicle that leads an ad hoc group has left."""


class _LeadBook(Ledger):
    """The ledger of a lead's term, which raises `LeadLeft` for a message after the lead has left."""

    def __init__(self, book: Ledger, term: LeadTerm) -> None:
        self._book = book
        self._term = term
        self._received = 0  # updates in the round in which the lead leaves

    def check(self, entry: LedgerEntry) -> None:
        self._book.check(entry)

    def enter(self, entry: LedgerEntry) -> None:
        term = self._term
        up = entry.direction == "up"
        # In the round of its leaving, the lead is gone from the start, or once it has received so many updates.
        if entry.round == term.left and (term.received is None or (up and self._received >= term.received)):
            raise LeadLeft
        self._book.enter(entry)
        self._received += up and entry.round == term.left


def follow_leads(
    members: Sequence[str], first: str, rounds: Sequence[RoundTiming], region: str
) -> tuple[LeadTerm, ...]:
    """Return the terms of a group's leads over timed rounds, whose clients are vehicles of `region`.

    The lead, `first` at the beginning, leaves if it is absent from a round, or lost in it for one of `LEAVES` while
    updates of others are under way. The member present with the lowest name takes over, of those that have not led
    before if there are any.
    """
    terms, lead, since, gone = list[LeadTerm](), first, 1, {first}
    for timing in rounds:
        clients = {f"{region}/{client.client}": client for client in timing.clients}
        there = sorted(name for name in members if name in clients)
        of_lead, received = clients.get(lead), None
        if of_lead is not None:
            if of_lead.dropped not in LEAVES:
                continue
            others = [client for name, client in clients.items() if name != lead and not client.dropped]
            received = sum(client.end_s <= of_lead.end_s for client in others)
            if received == len(others):
                continue  # it left after the end of the round
        following = [name for name in there if name != lead]
        if not following:
            continue  # no other member is present
        terms.append(LeadTerm(lead, since, timing.round, received))
        lead, since = next((name for name in following if name not in gone), following[0]), timing.round
        gone.add(lead)
    return (*terms, LeadTerm(lead, since))


def _keeps(term: LeadTerm, key: tuple[int, str], outage: Outage) -> bool:
    """Return whether an outage concerns the update of the lead during its term, which is sent over no link."""
    number, client = key
    within = term.first <= number <= (number if term.left is None else term.left)
    return client == term.lead and within and outage.sent_bytes is not None


def federate_led(
    run: RunRounds,
    weights: Weights,
    account: Account,
    terms: Sequence[LeadTerm],
    on_round: OnRound,
    *,
    state: FederationState,
    done: int = 0,
) -> LocalUpdate:
    """Run the rounds of a group under leads with these `terms`, by `run`, which keeps `state`.

    A round whose lead leaves begins again under the next one, without the vehicle that left: the messages of both
    attempts are in the ledger. Raises as `federate`.
    """
    reached = done, weights

    def keep(number: int, combined: Weights, loss: float | None) -> None:
        nonlocal reached
        reached = number, combined
        on_round(number, combined, loss)

    outages = dict(account.outages)
    for term in terms:
        if term.left is not None and term.left <= reached[0]:
            continue
        there = {key: outage for key, outage in outages.items() if not _keeps(term, key, outage)}
        led = replace(account, outages=there, within=frozenset({term.lead}), ledger=_LeadBook(account.ledger, term))
        try:
            return run(reached[1], led, reached[0], keep)
        except LeadLeft:
            assert term.left is not None
            state.server = {}  # lost with the lead; clients keep their state, which changes at the end of a round only
            lost = outages.get((term.left, term.lead))
            outages[term.left, term.lead] = Outage(LEFT_TOWN if lost is None else lost.reason)
    return LocalUpdate(reached[1], 0, 0.0)
