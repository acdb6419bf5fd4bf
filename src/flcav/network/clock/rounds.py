"""Simulated clock of federated rounds: transfers over links with time-varying rates, and computation.

All rates are constant between two events (an instant of the trace, the end of a transfer or of a computation), so that
the transferred bytes are the exact integral of the rates over time.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Annotated

import numpy as np
from pydantic import Field

from flcav.arrays import Mask
from flcav.config import Config, InputError
from flcav.network.clock.records import ClientTiming, ClientWork, RoundTiming
from flcav.network.radio.budget import Radio, shared_rates_bps
from flcav.network.radio.links import RadioLinks, Wireline
from flcav.storage.records import LEFT_OUT

LEFT_TOWN = "left the town"
NO_COVERAGE = "out of coverage"
NEARER = "nearer to {unit}"
DEADLINE = "past the deadline"
TRACE_ENDS = "the trace ends"
TIE = 1e-9  # [s] within which events are simultaneous


class RoundRules(Config):
    """Conditions on which a client is dropped from a round."""

    outage_s: float = Field(default=1.0, gt=0, le=3600)  # without a rate: radio link failure, T310 of TS 38.331
    handover_margin_m: float = Field(default=0.0, ge=0, le=1e6)  # another edge server must be nearer by more than this
    deadline_s: float | None = Field(default=None, gt=0)  # after the clients' start; None waits for all


class NetworkSettings(Config):
    """Radio, wireline and rules of a simulated network: a YAML file of the command line."""

    radio: Radio = Radio()
    wireline: Wireline = Wireline()
    rounds: RoundRules = RoundRules()
    throughput: Annotated[str | None, LEFT_OUT] = (
        None  # CSV of measured rates in place of the radio: vehicle, time_s, mbps, and optionally link
    )
    throughput_sha256: Annotated[str | None, LEFT_OUT] = (
        None  # of that file; a run fills it in, and takes no other file from then on
    )


class Phase(IntEnum):
    """Phase of a client in a round."""

    DOWNLOAD = 0
    COMPUTE = 1
    UPLOAD = 2
    OVER = 3


class ClientPhases:
    """State of K clients on the clock: phase, remaining work, and the time spent in each phase."""

    def __init__(
        self, links: RadioLinks, work: Sequence[ClientWork], number: int, start_s: float, rules: RoundRules
    ) -> None:
        self.links, self.work, self.number, self.rules = links, tuple(work), number, rules
        self.time_s = start_s
        self.start_s = np.full(len(work), start_s)  # (K,) [s]
        self.column = np.array([links.vehicle.index(w.client) for w in work], dtype=np.int64)  # (K,) in the links
        self.received = links.received_dbm[:, self.column]  # (T, K, U) [dBm]
        self.amount = np.array([(8 * w.download_bytes, w.compute_s, 8 * w.upload_bytes) for w in work], np.float64)
        self.left = self.amount.copy()  # (K, 3) remaining bits, seconds, bits
        self.spent = np.zeros_like(self.amount)  # (K, 3) [s]
        self.phase = np.zeros(len(work), np.int64)
        self.stalled_since = np.full(len(work), np.inf)
        self.end_s = np.full(len(work), np.nan)
        self.dropped = [""] * len(work)
        self.server = links.distance_m[self.instant][self.column].argmin(axis=1)

    @property
    def instant(self) -> int:
        """The latest instant of the trace."""
        return int(np.searchsorted(self.links.time_s, self.time_s + TIE, side="right")) - 1

    @property
    def until_next_s(self) -> float:
        """The time until the next instant of the trace [s]."""
        return float(self.links.time_s[self.instant + 1]) - self.time_s

    @property
    def ends(self) -> bool:
        """Whether the trace ends here."""
        return self.instant == len(self.links.time_s) - 1

    def run(self) -> tuple[ClientTiming, ...]:
        """Advance from event to event until every client's update has arrived or is dropped."""
        while True:
            self._drop()
            active = self.phase < Phase.OVER
            if not active.any():
                return tuple(map(self._timing, range(len(self.work))))
            self._advance(active)

    def _advance(self, active: Mask) -> None:
        """Advance the active clients, at least one, to the next event, and end the phases that are complete."""
        transfers = active & (self.phase != Phase.COMPUTE)
        if (measured := self.links.measured_bps) is not None:
            rates = np.where(transfers, measured[self.instant, self.column], 0.0)
        else:
            rates = shared_rates_bps(self.received[self.instant], self.server, transfers, self.links.radio)
        speed = np.where(self.phase == Phase.COMPUTE, 1.0, rates)  # (K,) bit/s; for computing, seconds per second
        # An outage is timed from its first event without a rate, so that later events do not restart the timer.
        self.stalled_since[~(transfers & (speed == 0))] = np.inf
        self.stalled_since[transfers & (speed == 0) & np.isinf(self.stalled_since)] = self.time_s
        rows = np.flatnonzero(active)
        left = self.left[rows, self.phase[rows]]
        with np.errstate(divide="ignore", invalid="ignore"):
            seconds = np.where(left > 0, left / speed[rows], 0.0)
        deadline_s = np.inf if self.rules.deadline_s is None else self.rules.deadline_s
        events = (
            self.until_next_s,
            float(seconds.min()),
            float(self.stalled_since.min()) + self.rules.outage_s - self.time_s,
            float(self.start_s[rows].min()) + deadline_s - self.time_s,
        )
        span = max(min(events), 0.0)
        done = seconds <= span + TIE
        self.left[rows, self.phase[rows]] = np.where(done, 0.0, left - speed[rows] * span)
        self.spent[rows, self.phase[rows]] += span
        self.time_s += span
        self.phase[rows[done]] += 1
        self.end_s[rows[self.phase[rows] == Phase.OVER]] = self.time_s

    def _drop(self) -> None:
        """Drop the clients that cannot continue at this time, each for the first reason that applies."""
        n = self.instant
        rules = self.rules
        distance = np.nan_to_num(self.links.distance_m[n, self.column], nan=np.inf)  # (K, U)
        nearest = distance.argmin(axis=1)
        to_server = distance[np.arange(len(self.work)), self.server]
        late = self.time_s + TIE >= self.start_s + (np.inf if rules.deadline_s is None else rules.deadline_s)
        reasons = {
            LEFT_TOWN: ~self.links.present[n, self.column],
            NEARER: distance.min(axis=1) + rules.handover_margin_m < to_server,
            NO_COVERAGE: self.stalled_since + rules.outage_s <= self.time_s + TIE,
            DEADLINE: late,
            TRACE_ENDS: np.full(len(self.work), self.ends),
        }
        for reason, holds in reasons.items():
            for k in np.flatnonzero(holds & (self.phase < Phase.OVER)).tolist():
                self.dropped[k] = reason.format(unit=self.links.unit[nearest[k]])
                self.phase[k], self.end_s[k] = Phase.OVER, self.time_s

    def _timing(self, k: int) -> ClientTiming:
        moved = (self.amount[k] - self.left[k]) // 8
        return ClientTiming(
            client=self.work[k].client,
            server=self.links.unit[self.server[k]],
            round=self.number,
            start_s=float(self.start_s[k]),
            download_s=float(self.spent[k, Phase.DOWNLOAD]),
            compute_s=float(self.spent[k, Phase.COMPUTE]),
            upload_s=float(self.spent[k, Phase.UPLOAD]),
            end_s=float(self.end_s[k]),
            downloaded_bytes=int(moved[Phase.DOWNLOAD]),
            uploaded_bytes=int(moved[Phase.UPLOAD]),
            dropped=self.dropped[k],
        )


def time_round(
    links: RadioLinks, work: Sequence[ClientWork], number: int, start_s: float, rules: RoundRules
) -> tuple[ClientTiming, ...]:
    """Return the times of the clients of round `number`, which all start at `start_s` [s] on the trace's clock.

    A client is served by the unit that is nearest at that time. It drops out once another is nearer, or it leaves the
    town, or has no rate for `rules.outage_s`, or at the deadline, or where the trace ends; the others continue. Raises
    `InputError` for a start outside the trace, for no clients, unknown or repeated ones, and for one that is not in the
    town at the start.
    """
    first = float(links.time_s[0])
    last = float(links.time_s[-1])
    if not first <= start_s < last:
        raise InputError(f"round {number} begins at {start_s:g} s, but the trace is from {first:g} to {last:g} s")
    if not work:
        raise InputError(f"round {number}: no client is in the town at {start_s:g} s")
    names = [client.client for client in work]
    if odd := [name for name in names if name not in links.vehicle or names.count(name) > 1]:
        raise InputError(f"round {number}: '{odd[0]}' is no vehicle of the links, or named twice")
    instant = int(np.searchsorted(links.time_s, start_s, side="right")) - 1
    here = links.present[instant]
    if away := [name for name in names if not here[links.vehicle.index(name)]]:
        raise InputError(f"round {number}: '{away[0]}' is not in the town at {start_s:g} s")
    return ClientPhases(links, work, number, start_s, rules).run()


def simulate_rounds(
    links: RadioLinks,
    works: Sequence[Mapping[str, ClientWork]],
    settings: NetworkSettings,
    *,
    start_s: float | None = None,
    edge_rounds_per_cloud_round: int | None = None,
    model_bytes: int = 0,
) -> tuple[RoundTiming, ...]:
    """Return the timed rounds of a federation over radio links, one after another.

    Every vehicle with work in a round that is in the town at its start takes part. Before the edge rounds of a cloud
    round the cloud's model is sent to the edge servers, and after them their models to the cloud, over
    `settings.wireline`. Raises `InputError` as `time_round`, and where the number of rounds is 0, or no multiple of k.

    Args:
        links: radio links of the vehicles.
        works: work of each round, by vehicle.
        settings: settings of the network and its clock.
        start_s: time at which the first round begins [s]; None: the start of the links' trace.
        edge_rounds_per_cloud_round: k, number of edge rounds in a cloud round; None: there is no cloud.
        model_bytes: size of the cloud's model [bytes].
    """
    k = edge_rounds_per_cloud_round
    if not works or (k is not None and (k < 1 or len(works) % k)):
        raise InputError(f"{len(works)} edge rounds, {k} to a cloud round: a whole number of cloud rounds is wanted")
    wire = 0.0 if k is None else settings.wireline.seconds(model_bytes)
    now = float(links.time_s[0]) if start_s is None else start_s
    records = []
    for number, work in enumerate(works, 1):
        down = wire if k is not None and (number - 1) % k == 0 else 0.0
        up = wire if k is not None and number % k == 0 else 0.0
        begins = now + down
        instant = int(np.searchsorted(links.time_s, begins, side="right")) - 1
        here = [
            name for name, present in zip(links.vehicle, links.present[instant].tolist()) if present and name in work
        ]
        clients = time_round(links, [work[name] for name in here], number, begins, settings.rounds)
        ends = max(client.end_s for client in clients) + up
        records.append(RoundTiming(number, now, ends, down, up, clients))
        now = ends
    return tuple(records)
