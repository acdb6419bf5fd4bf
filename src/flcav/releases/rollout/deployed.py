"""Roll-out to a deployed fleet: its vehicles fetch both repositories through the fleet's proxy, canaries first.

The customer's keys sign one share of the fleet after the other while the shadow runs of its vehicles agree, and a share
of 0 where they do not. Bytes are those that crossed the proxy's sockets.
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

LEAST = 2  # canaries: shadow runs of one vehicle do not tell
POLL_S = 0.5  # between looks at the vehicles' reports


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

    It ends where every registered vehicle drives the release, shadow runs stop it, or do not tell.

    Args:
        fleet: folder of the fleet's authority.
        provider: folder of the provider, whose published repository is offered.
        customer: that of the customer.
        keys: private keys of the customer, as many as its targets want, so that a stop can be signed at once.
        ledger: where every downlink is entered; None: nowhere.
        share: of the fleet, to begin with; None: as the customer has signed it, or more for two canaries.
        data: dataset whose drives stand for what the vehicles of this machine meet; None: as before.
        patience_s: time that the vehicles of a share have; then those that have reported decide.
        progress: callback for the vehicles that have the release.

    Raises:
        InputError: for a fleet that is not up or has no vehicles, too few keys, and a release that was stopped.
    """
    read_ready(fleet)
    names, directive = list_registered(fleet), read_directive(customer, TASK)
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
    """Return the vehicles whose certificates are in force; raises `InputError` where there are none."""
    registry = open_registry(fleet)
    names = [own.name for own in registry.list_vehicles() if own.describe_state() == "registered"]
    registry.close()
    if not names:
        raise InputError(f"{fleet}: has no registered vehicle")
    return names


def equip_fleet(fleet: Path, provider: Path, customer: Path, data: Path | None) -> None:
    """Let the fleet's vehicles on this machine trust both parties, unless they trust others, and give each a drive."""
    for out, party in ((provider, "provider"), (customer, "customer")):
        if read_party(out) != party:
            raise InputError(f"{out}: is not of the {party}")
    roots = read_root(provider), read_root(customer)
    drives = [] if data is None else list_drives(Dataset.open(data))
    for number, folder in enumerate(sorted((fleet / VEHICLES).glob("*"))):
        drive = None
        if data is not None:
            own = drives[number % len(drives)]
            drive = RecordedDrive(str(data.resolve()), own.scene, own.agent)
        equip_vehicle(folder, None if trusts_roots(folder / FOLDER) else roots, drive)


def share_of(stage: float, names: Sequence[str], candidate: Candidate) -> float:
    """Return the share that reaches `stage` of a fleet's vehicles, rounded up, and two at least, by their places."""
    places = sorted(place_in_queue(name, candidate.task, candidate.release) for name in names)
    count = max(math.ceil(stage * len(places)), LEAST)
    return 1.0 if count >= len(places) else (math.floor(places[count - 1] * MILLION) + 1) / MILLION


def _with_share(directive: Directive, share: float) -> Directive:
    return directive.model_copy(update={"share_ppm": round(share * MILLION)})


@dataclass(frozen=True)
class _Rollout:
    """A roll-out under way."""

    fleet: Path
    customer: Path
    keys: tuple[Path, ...]
    candidate: Candidate
    names: Sequence[str]
    ledger: Ledger
    booked: dict[str, int] = field(default_factory=dict)  # bytes down to each vehicle that are in the ledger, or before

    def __post_init__(self) -> None:
        self.booked.update(self.count_down(read_reports(self.fleet)))

    def assigned(self, directive: Directive) -> list[str]:
        return [name for name in self.names if is_assigned(name, TASK, directive)]

    def sign(self, share: float) -> Directive:
        """Let the customer sign a share of the fleet, unless it is what it was, and publish."""
        directive = read_directive(self.customer, TASK)
        if _with_share(directive, share) != directive:
            directive, _ = change_share(self.customer, TASK, share, self.keys)
        publish(self.customer)
        return directive

    def take_turn(self, share: float, patience_s: float) -> Turn:
        """Sign a share, and wait until its vehicles have the release, shadow runs stop it, or the time is over."""
        began, until = time.time(), time.monotonic() + patience_s
        before = {name for name, kept in read_reports(self.fleet).items() if self.drives(kept)}
        assigned = self.assigned(self.sign(share))
        while True:
            reports = {name: kept for name, kept in read_reports(self.fleet).items() if name in assigned}
            reached, decision = {name for name, kept in reports.items() if self.drives(kept)}, self.judge(reports)
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
        """Return what follows from the shadow runs of the release beside the network that it replaces."""
        runs = [kept.report.shadow for kept in reports.values() if kept.report.shadow is not None]
        wanted = (self.candidate.driving, self.candidate.weights)
        fitting = [run for run in runs if (run.driving, run.candidate) == wanted]
        return judge_shadows(fitting) if any(run.frames for run in fitting) else None

    def count_down(self, reports: Mapping[str, KeptReport]) -> dict[str, int]:
        """Return the bytes that crossed the sockets down to each vehicle for releases, so far."""
        crossed = read_traffic(self.fleet).vehicles  # is written with a delay, reports are not
        known = {name: own.release_down for name, own in crossed.items()}
        return {
            name: max(known.get(name, 0), reports[name].down_bytes if name in reports else 0) for name in self.names
        }

    def book(self) -> dict[str, int]:
        """Enter in the ledger what went down to each vehicle since the last time, and return it."""
        now = self.count_down(read_reports(self.fleet))
        moved = {name: count - self.booked[name] for name, count in now.items() if count > self.booked[name]}
        for name, count in moved.items():
            self.ledger.enter(LedgerEntry(STAGE, TASK, "wireless", "down", self.candidate.release, name, count))
        self.booked.update(now)
        return moved
