"""Rehearsal of a roll-out on a simulated fleet: shares, downloads over the radio, shadow runs, stop and roll-back.

Both parties get temporary repositories and keys, so that no owner's key is needed. Canaries run their previous network
and the new one on the same frames; then the next share follows, or the roll-out stops and is rolled back.
"""

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.fleet.releases import ShadowReport
from flcav.interface.progress import Report, ignore_progress
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network
from flcav.releases.candidate import WEIGHTS, Candidate, check_files, read_candidate
from flcav.releases.checking import RepositorySources, open_sources
from flcav.releases.repositories.metadata import MILLION, Directive, is_assigned, read_root
from flcav.releases.repositories.repository import create_repository, publish, stage_release
from flcav.releases.rollout.simulated_fleet import (
    Delivered,
    FleetDrive,
    SimulatedFleet,
    SimulatedRadio,
    build_fleet,
    list_drives,
    update_over_radio,
)
from flcav.releases.rollout.stages import (
    STAGES,
    Rollout,
    ShadowDecision,
    Turn,
    change_share,
    judge_shadows,
    next_share,
    roll_back,
    run_shadow,
)

MOST_TURNS = 12  # of a rehearsal; a vehicle drives once per turn
KEYS = (1, 2)  # signing keys of a party


@dataclass(frozen=True)
class _Parties:
    """Repositories and keys of both parties, in one folder."""

    folder: Path
    task: str

    def keys(self, party: str) -> list[Path]:
        return [self.folder / party / "keys" / f"{number}.pem" for number in KEYS]

    def release(self, candidate: Path, share: float) -> None:
        """Sign a candidate for a share of the fleet as both parties, and publish."""
        directive = Directive(release=read_candidate(candidate).release, share_ppm=round(share * MILLION))
        for party, instruction in (("provider", None), ("customer", directive)):
            stage_release(self.folder / party, candidate, self.keys(party), instruction)
            publish(self.folder / party)

    def widen(self, share: float) -> None:
        """Sign another share as the customer, and publish."""
        change_share(self.folder / "customer", self.task, share, self.keys("customer"))
        publish(self.folder / "customer")

    def sources(self) -> RepositorySources:
        return open_sources(*(str(self.folder / party / "repository") for party in ("provider", "customer")))


def rehearse(
    candidate: Path,
    earlier: Path,
    data: Path,
    out: Path,
    ledger: Ledger | None = None,
    *,
    vehicles: int = 200,
    poles: Sequence[int] = (),
    settings: NetworkSettings | None = None,
    seed: int = 0,
    progress: Report = ignore_progress,
) -> Rollout:
    """Return the outcome of a roll-out of a candidate to a simulated fleet with an earlier release.

    Args:
        candidate: folder of the new release.
        earlier: folder of the driving release.
        data: dataset with the vehicles' drives, the traffic and the town.
        out: new folder for both parties' repositories; the fleet's folder in it is removed at the end.
        ledger: in which every downlink is entered; None: none.
        vehicles: number of vehicles.
        poles: numbers of the town's poles with roadside units; empty: those of the recording.
        settings: of the network.
        seed: of shadowing and losses.
        progress: callback with the turns done and their limit.

    Raises:
        InputError: for a folder that exists, candidates that do not follow each other, and a dataset without drives,
            traffic or poles.
    """
    new, old = _check_sequence(candidate, earlier)
    if out.exists():
        raise InputError(f"{out}: exists already; a rehearsal is a new folder")
    opened, spent = Dataset.open(data), ledger if ledger is not None else Ledger(LinkMegabytes(0, 0))
    radio = SimulatedRadio(opened, settings or NetworkSettings(), tuple(poles), seed)
    drives = list_drives(opened)
    radio.links(drives[0].scene)  # raises without traffic or poles, before anything is written
    parties = _Parties(out, new.task)
    try:
        for party in ("provider", "customer"):
            create_repository(out / party, party)
        parties.release(earlier, 1.0)
        roots = (read_root(out / "provider"), read_root(out / "customer"))
        fleet = build_fleet(out / "fleet", vehicles, drives, roots, parties.sources(), new.task)
        shadows = _Shadows(opened, earlier / WEIGHTS, candidate / WEIGHTS, old.weights, new.weights)
        rehearsal = _Rehearsal(parties, fleet, radio, spent)
        turns = rehearsal.roll_out(candidate, shadows, progress)
        stopped = turns[-1].decision is not None and turns[-1].decision.judgement == "stop"
        if stopped:
            parties.widen(0.0)
            back = out / "rollback"
            roll_back(earlier, new.release + 1, "Shadow runs disagree.", back, new.weights)
            parties.release(back, 1.0)
            turns += rehearsal.spread(new.release + 1, len(turns))
        drive = Counter(fleet.installed(name).release for name in fleet.names)
        wanted = new.release + 1 if stopped else new.release
        return Rollout(stopped, drive[wanted] == vehicles, tuple(turns), dict(sorted(drive.items())))
    finally:
        shutil.rmtree(out / "fleet", ignore_errors=True)


class _Shadows:
    """The shadow runs of drives, cached by drive."""

    def __init__(self, data: Dataset, driving: Path, candidate: Path, old: str, new: str) -> None:
        self.data = data
        self.networks = ((load_network(OBJECTS, driving), old), (load_network(OBJECTS, candidate), new))
        self.reports: dict[FleetDrive, ShadowReport] = {}

    def run(self, drives: Sequence[FleetDrive]) -> ShadowDecision | None:
        """Return the decision by all drives so far and these; None without any."""
        for drive in drives:
            if drive not in self.reports:
                numbers = self.data.select(agents=[drive.agent], scenes=[drive.scene])
                self.reports[drive] = run_shadow(drive.name, map(self.data.frame, numbers), *self.networks)
        return judge_shadows([*self.reports.values()]) if self.reports else None


@dataclass(frozen=True)
class _Rehearsal:
    """A rehearsal in progress: parties, fleet, radio, and ledger."""

    parties: _Parties
    fleet: SimulatedFleet
    radio: SimulatedRadio
    ledger: Ledger

    def roll_out(self, candidate: Path, shadows: _Shadows, progress: Report) -> list[Turn]:
        """Return the turns until the whole fleet has the release, it is stopped, or `MOST_TURNS` is reached."""
        release = read_candidate(candidate).release
        share = STAGES[0]
        fleet = self.fleet
        self.parties.release(candidate, share)
        turns: list[Turn] = []
        fetched: set[str] = set()
        while len(turns) < MOST_TURNS:
            number = len(turns)
            moved = self._deliver(release, share, number, fetched)
            having = [name for name in fleet.names if fleet.installed(name).release == release]
            decision = shadows.run([fleet.drive_of(name, number) for name in having])
            turns.append(Turn(*moved, decision))
            progress(len(turns), MOST_TURNS, turns[-1].describe())
            if (decision is not None and decision.judgement == "stop") or len(having) == len(fleet.names):
                break
            wider = next_share(share, decision) if decision is not None else share
            if not self._assigned(release, share):
                wider = next(
                    stage for stage in STAGES if stage > share
                )  # a small fleet may have no vehicle in the first stage
            if wider != share:
                share = wider
                self.parties.widen(share)
        return turns

    def spread(self, release: int, first: int) -> list[Turn]:
        """Return the turns until every vehicle has a release for the whole fleet, or `MOST_TURNS` is reached."""
        turns: list[Turn] = []
        fetched: set[str] = set()
        while len(turns) < MOST_TURNS and not (turns and turns[-1].reached == turns[-1].assigned):
            turns.append(Turn(*self._deliver(release, 1.0, first + len(turns), fetched), None))
        return turns

    def _assigned(self, release: int, share: float) -> list[str]:
        directive = Directive(release=release, share_ppm=round(share * MILLION))
        return [name for name in self.fleet.names if is_assigned(name, self.fleet.task, directive)]

    def _deliver(
        self, release: int, share: float, number: int, fetched: set[str]
    ) -> tuple[int, float, int, int, tuple[Delivered, ...], float, float]:
        """Deliver a release to vehicles of a share that lack it; return the fields of `Turn` before the decision."""
        assigned = self._assigned(release, share)
        lacking = [name for name in assigned if self.fleet.installed(name).release != release]
        before = self._megabytes()
        sources = self.parties.sources()
        arrivals = update_over_radio(self.fleet, lacking, number, self.radio, sources, self.ledger, fetched)
        reached = sum(self.fleet.installed(name).release == release for name in assigned)
        after = self._megabytes()
        return release, share, len(assigned), reached, tuple(arrivals), after[0] - before[0], after[1] - before[1]

    def _megabytes(self) -> tuple[float, float]:
        """Return the downlink so far, wireless and wireline [MB]."""
        return self.ledger.used_mb("wireless", direction="down"), self.ledger.used_mb("wireline", direction="down")


def _check_sequence(candidate: Path, earlier: Path) -> tuple[Candidate, Candidate]:
    """Return both descriptions; raises `InputError` where the candidate does not follow the earlier release."""
    new, old = read_candidate(candidate), read_candidate(earlier)
    for folder, described in ((candidate, new), (earlier, old)):
        check_files(folder, described)
    if new.task != old.task or new.task != OBJECTS.name:
        raise InputError(f"{candidate}: a rehearsal takes two releases of '{OBJECTS.name}'")
    if new.driving != old.weights:
        raise InputError(f"{candidate}: is proposed to replace another network than that of {earlier}")
    if new.release <= old.release:
        raise InputError(f"{candidate}: release {new.release} does not rise above {old.release}, which drives")
    return new, old
