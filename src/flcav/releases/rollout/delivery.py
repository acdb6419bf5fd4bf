"""Delivery of a release over the radio: who gets it when, by coverage, and what it costs, in the ledger.

Vehicles of the trace download from the nearest roadside unit at the rate that they have there; the band is shared. One
that leaves coverage begins anew at its next attempt. Every unit fetches the files once over wireline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.network.clock.records import ClientWork
from flcav.network.clock.rounds import NetworkSettings, time_round
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.network.radio.links import RadioLinks

STAGE = "release"
WAIT_S = 1.0  # between two attempts


@dataclass(frozen=True)
class Delivered:
    """The delivery to one vehicle."""

    vehicle: str
    at_s: float | None  # on the trace's clock; None: not by its end
    attempts: int
    bytes: int  # on the radio, lost attempts included
    reason: str  # why the last attempt failed; empty where it arrived


def deliver(
    links: RadioLinks,
    vehicles: Sequence[str],
    release: int,
    size_bytes: int,
    settings: NetworkSettings,
    ledger: Ledger,
    task: str = "objects",
    fetched: set[str] | None = None,
) -> tuple[Delivered, ...]:
    """Return when each of `vehicles` has a release of `size_bytes`; what is sent enters the ledger.

    Downlinks count against no budget, but are entered message by message, and those of lost attempts too. fetched:
    units that have the files already, to which those are added that fetch them now; None: none has.
    """
    waiting = dict.fromkeys(vehicles)
    attempts, moved = dict.fromkeys(vehicles, 0), dict.fromkeys(vehicles, 0)
    reasons = dict.fromkeys(vehicles, "never in the town")
    arrived: dict[str, float] = {}
    units = set() if fetched is None else fetched
    now, end = float(links.time_s[0]), float(links.time_s[-1])
    while waiting and now < end:
        instant = int(np.searchsorted(links.time_s, now, side="right")) - 1
        here = [
            name for name, there in zip(links.vehicle, links.present[instant], strict=True) if there and name in waiting
        ]
        if here:
            work = [ClientWork(name, size_bytes, 0.0, 0) for name in here]
            timings = time_round(links, work, max(attempts.values()) + 1, now, settings.rounds)
            for each in timings:
                attempts[each.client] += 1
                moved[each.client] += each.downloaded_bytes
                reasons[each.client] = each.dropped
                if each.server not in units:
                    units.add(each.server)
                    ledger.enter(LedgerEntry(STAGE, task, "wireline", "down", release, each.server, size_bytes))
                ledger.enter(LedgerEntry(STAGE, task, "wireless", "down", release, each.client, each.downloaded_bytes))
                if not each.dropped:
                    arrived[each.client] = each.end_s
                    del waiting[each.client]
            now = max(now, *(each.end_s for each in timings))  # attempts begin together
        now += WAIT_S
    return tuple(
        Delivered(name, arrived.get(name), attempts[name], moved[name], "" if name in arrived else reasons[name])
        for name in vehicles
    )
