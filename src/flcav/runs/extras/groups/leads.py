"""Rounds of an ad hoc group: one of its vehicles leads; if it leaves, even in mid-round, the next one takes over.

The lead is the server of the group's rounds, and its own update crosses no link. A lead that leaves in mid-round takes
with it what it has received. All that are left have the weights that the round began with, so the next lead begins it
again: it asks for the received updates once more, and the weights are those of a round that it led from its start. What
a strategy keeps at the server between rounds, such as moments, is lost with the lead.
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

LEAVES = (LEFT_TOWN, NO_COVERAGE)  # why a vehicle is lost that cannot lead any longer


class LeadLeft(Exception):
    """Raised when the vehicle that leads an ad hoc group has left."""


class _LeadBook(Ledger):
    """The ledger of a term: `LeadLeft` is raised where the lead is gone when a message would be entered."""

    def __init__(self, book: Ledger, term: LeadTerm) -> None:
        self._book, self._term, self._received = book, term, 0

    def check(self, entry: LedgerEntry) -> None:
        self._book.check(entry)

    def enter(self, entry: LedgerEntry) -> None:
        term, up = self._term, entry.direction == "up"
        if entry.round == term.left and (term.received is None or (up and self._received >= term.received)):
            raise LeadLeft
        self._book.enter(entry)
        self._received += up and entry.round == term.left


def follow_leads(
    members: Sequence[str], first: str, rounds: Sequence[RoundTiming], region: str
) -> tuple[LeadTerm, ...]:
    """Return the terms of a group's leads over timed rounds, whose clients are vehicles of `region`.

    The lead, at first `first`, is gone where it is not in a round, or is lost in it for one of `LEAVES` while updates
    of others are under way. The member with the lowest name takes over that is there, and has not led before if any.
    """
    terms, lead, since, gone = list[LeadTerm](), first, 1, {first}
    for timing in rounds:
        clients = {f"{region}/{each.client}": each for each in timing.clients}
        there = sorted(name for name in members if name in clients)
        own, received = clients.get(lead), None
        if own is not None:
            if own.dropped not in LEAVES:
                continue
            others = [each for name, each in clients.items() if name != lead and not each.dropped]
            received = sum(each.end_s <= own.end_s for each in others)
            if received == len(others):
                continue  # the round was over before
        following = [name for name in there if name != lead]
        if not following:
            continue  # nobody is left who could
        terms.append(LeadTerm(lead, since, timing.round, received))
        lead, since = next((name for name in following if name not in gone), following[0]), timing.round
        gone.add(lead)
    return (*terms, LeadTerm(lead, since))


def _keeps(term: LeadTerm, key: tuple[int, str], outage: Outage) -> bool:
    """Return whether an outage concerns the lead's update in its own term, which is sent over no link."""
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
    """Run the rounds of a group whose leads have these `terms`, by `run`, whose rounds keep `state`.

    A round whose lead leaves begins again under the next one, without whoever left: the messages of both attempts are
    in the ledger. Raises as `federate`.
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
        there = {key: each for key, each in outages.items() if not _keeps(term, key, each)}
        own = replace(account, outages=there, within=frozenset({term.lead}), ledger=_LeadBook(account.ledger, term))
        try:
            return run(reached[1], own, reached[0], keep)
        except LeadLeft:
            assert term.left is not None
            state.server = {}  # clients keep theirs: it changes when a round is over
            lost = outages.get((term.left, term.lead))
            outages[term.left, term.lead] = Outage(LEFT_TOWN if lost is None else lost.reason)
    return LocalUpdate(reached[1], 0, 0.0)
