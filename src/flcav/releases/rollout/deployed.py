"""Roll-out to a deployed fleet, whose vehicles fetch both repositories through the fleet's proxy, canaries first.

The customer's keys sign growing shares of the fleet while the shadow runs of its vehicles agree, and a share of 0 if
they disagree. Bytes are those on the proxy's sockets.
"""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.fleet.authority import open_registry
from flcav.fleet.releases import KeptReport, ReleaseOffer, read_reports
from flcav.fleet.traffic import read_traffic
from flcav.fleet.up import VEHICLES, read_ready
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.releases.candidate import Candidate
from flcav.releases.checking import trusts_roots
from flcav.releases.repositories.metadata import (
    MILLION,
    Directive,
    is_assigned,
    place_in_queue,
    read_party,
    read_released,
    read_root,
)
from flcav.releases.repositories.repository import publish
from flcav.releases.repositories.status import read_repository_status
from flcav.releases.rollout.simulated_fleet import STAGE, Delivered, list_drives
from flcav.releases.rollout.stages import (
    STAGES,
    Rollout,
    ShadowDecision,
    Turn,
    change_share,
    judge_shadows,
    read_directive,
)
from flcav.releases.rollout.updater import FOLDER, TASK, RecordedDrive, equip_vehicle

LEAST = 2  # number of canaries, since one vehicle's shadow run gives no interval
POLL_S = 0.5  # interval of reading the vehicles' reports [s]


def roll_out(
    fleet: Path,
    provider: Path,
    customer: Path,
    keys: Sequence[Path],
    ledger: Ledger | None = None,
    *,
    share: float | None = None,
    data: Path | None = None,
    patience_s: float = 600.0,
    progress: Report = ignore_progress,
) -> Rollout:
    """Return the outcome of a roll-out of the customer's current release to a running fleet.

    It ends when every registered vehicle drives the release, or when shadow runs stop it or are inconclusive.

    Args:
        fleet: folder of the fleet's authority.
        provider: folder of the provider, whose published repository is offered.
        customer: folder of the customer, likewise.
        keys: private keys of the customer, as many as its targets need, so that a stop can be signed at once.
        ledger: in which every downlink is entered; None: none.
        share: first share of the fleet; None: that signed by the customer, increased to two canaries.
        data: dataset with the recorded drives of this machine's vehicles; None: unchanged.
        patience_s: timeout of a share [s], after which the vehicles that have reported decide.
        progress: callback with the number of vehicles that have the release.

    Raises:
        InputError: for a fleet that is not up or has no vehicles, too few keys, and a release that was stopped.
    """
    read_ready(fleet)
    names = list_registered(fleet)
    directive = read_directive(customer, TASK)
    candidate = read_released(provider, TASK, directive.release)
    if len(keys) < (threshold := read_repository_status(customer, TASK).threshold):
        raise InputError(f"{len(keys)} of {threshold} keys of the customer: a roll-out that stops by itself needs all")
    if share is None and not directive.share and not directive.vehicles:
        raise InputError(f"release {directive.release} was stopped, or is for nobody; --share begins it")
    equip_fleet(fleet, provider, customer, data)
    ReleaseOffer(*(str((party / "repository").resolve()) for party in (provider, customer))).save(fleet)
    rollout = _Rollout(fleet, customer, tuple(keys), candidate, names, ledger or Ledger(LinkMegabytes(0, 0)))
    wanted = directive.share if share is None else share
    if len(rollout.assigned(_with_share(directive, wanted))) < min(LEAST, len(names)):
        wanted = share_of(STAGES[0], names, candidate)
    turns: list[Turn] = []
    while True:
        turns.append(rollout.take_turn(wanted, patience_s))
        progress(turns[-1].reached, len(names), turns[-1].describe())
        decision = turns[-1].decision
        if decision is None or decision.judgement != "go on" or turns[-1].assigned == len(names):
            break
        wanted = next((wider for stage in STAGES if (wider := share_of(stage, names, candidate)) > wanted), 1.0)
    stopped = decision is not None and decision.judgement == "stop"
    if stopped:
        rollout.sign(0.0)
    reports = read_reports(fleet)
    drive = Counter(reports[name].report.release if name in reports else 0 for name in names)
    complete = not stopped and drive[candidate.release] == len(names)
    return Rollout(stopped, complete, tuple(turns), dict(sorted(drive.items())))


def list_registered(fleet: Path) -> list[str]:
    """Return the vehicles whose certificates are in force; raises `InputError` if there are none."""
    registry = open_registry(fleet)
    names = [vehicle.name for vehicle in registry.list_vehicles() if vehicle.describe_state() == "registered"]
    registry.close()
    if not names:
        raise InputError(f"{fleet}: has no registered vehicle")
    return names


def equip_fleet(fleet: Path, provider: Path, customer: Path, data: Path | None) -> None:
    """Install both parties' roots in this machine's vehicles, unless they have roots, and assign them drives."""
    for out, party in ((provider, "provider"), (customer, "customer")):
        if read_party(out) != party:
            raise InputError(f"{out}: is not of the {party}")
    roots = read_root(provider), read_root(customer)
    drives = [] if data is None else list_drives(Dataset.open(data))
    for number, folder in enumerate(sorted((fleet / VEHICLES).glob("*"))):
        drive = None
        if data is not None:
            recorded = drives[number % len(drives)]
            drive = RecordedDrive(str(data.resolve()), recorded.scene, recorded.agent)
        equip_vehicle(folder, None if trusts_roots(folder / FOLDER) else roots, drive)


def share_of(stage: float, names: Sequence[str], candidate: Candidate) -> float:
    """Return the share that assigns at least `stage` of a fleet's vehicles, and two, by their places in the queue."""
    places = sorted(place_in_queue(name, candidate.task, candidate.release) for name in names)
    count = max(math.ceil(stage * len(places)), LEAST)
    return 1.0 if count >= len(places) else (math.floor(places[count - 1] * MILLION) + 1) / MILLION


def _with_share(directive: Directive, share: float) -> Directive:
    return directive.model_copy(update={"share_ppm": round(share * MILLION)})


@dataclass(frozen=True)
class _Rollout:
    """A roll-out in progress."""

    fleet: Path
    customer: Path
    keys: tuple[Path, ...]
    candidate: Candidate
    names: Sequence[str]
    ledger: Ledger
    booked: dict[str, int] = field(
        default_factory=dict
    )  # downloaded bytes already in the ledger, or before the roll-out, by vehicle

    def __post_init__(self) -> None:
        self.booked.update(self.count_down(read_reports(self.fleet)))

    def assigned(self, directive: Directive) -> list[str]:
        return [name for name in self.names if is_assigned(name, TASK, directive)]

    def sign(self, share: float) -> Directive:
        """Sign another share of the fleet as the customer, unless it is unchanged, and publish."""
        directive = read_directive(self.customer, TASK)
        if _with_share(directive, share) != directive:
            directive, _ = change_share(self.customer, TASK, share, self.keys)
        publish(self.customer)
        return directive

    def take_turn(self, share: float, patience_s: float) -> Turn:
        """Sign a share, and wait until its vehicles have the release, shadow runs stop it, or `patience_s` is over."""
        began, until = time.time(), time.monotonic() + patience_s
        before = {name for name, kept in read_reports(self.fleet).items() if self.drives(kept)}
        assigned = self.assigned(self.sign(share))
        while True:
            reports = {name: kept for name, kept in read_reports(self.fleet).items() if name in assigned}
            reached = {name for name, kept in reports.items() if self.drives(kept)}
            decision = self.judge(reports)
            stop = decision is not None and decision.judgement == "stop" and decision.vehicles >= LEAST
            if stop or len(reached) == len(assigned) or time.monotonic() > until:
                break
            time.sleep(POLL_S)
        moved = self.book()
        arrivals = [
            Delivered(name, kept.time - began if name in reached else None, 1, moved.get(name, 0), kept.report.refused)
            for name, kept in reports.items()
            if name not in before
        ]
        megabytes = sum(moved.values()) / 1e6
        counted = share, len(assigned), len(reached), tuple(arrivals), megabytes, None
        return Turn(self.candidate.release, *counted, decision)

    def drives(self, kept: KeptReport) -> bool:
        return (kept.report.task, kept.report.release) == (TASK, self.candidate.release)

    def judge(self, reports: Mapping[str, KeptReport]) -> ShadowDecision | None:
        """Return the decision by the shadow runs of the release against the network that it replaces."""
        runs = [kept.report.shadow for kept in reports.values() if kept.report.shadow is not None]
        wanted = (self.candidate.driving, self.candidate.weights)
        fitting = [run for run in runs if (run.driving, run.candidate) == wanted]
        return judge_shadows(fitting) if any(run.frames for run in fitting) else None

    def count_down(self, reports: Mapping[str, KeptReport]) -> dict[str, int]:
        """Return the bytes downloaded for releases so far, by vehicle, on the proxy's sockets."""
        crossed = read_traffic(self.fleet).vehicles  # written with a delay, unlike reports
        known = {name: traffic.release_down for name, traffic in crossed.items()}
        # the larger one is the later one
        return {
            name: max(known.get(name, 0), reports[name].down_bytes if name in reports else 0) for name in self.names
        }

    def book(self) -> dict[str, int]:
        """Enter the bytes downloaded since the last call in the ledger, and return them by vehicle."""
        now = self.count_down(read_reports(self.fleet))
        moved = {name: count - self.booked[name] for name, count in now.items() if count > self.booked[name]}
        for name, count in moved.items():
            self.ledger.enter(LedgerEntry(STAGE, TASK, "wireless", "down", self.candidate.release, name, count))
        self.booked.update(now)
        return moved
