"""A simulated fleet: vehicles that repeat recorded drives, download over radio, and install as real ones do.

A drive is one vehicle in one recorded scene. Vehicle i takes drive i in the first turn and the next drive in the next
turn; vehicles beyond the number of drives repeat them on other days. Folders, metadata, signatures and installation are
those of `flcav release install`. A vehicle downloads from the nearest roadside unit at the rate of its radio link at
that instant of the trace; the band is shared, and a download interrupted by loss of coverage starts again. A roadside
unit fetches the files once over wireline.
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.network.clock.records import ClientWork
from flcav.network.clock.rounds import NetworkSettings, time_round
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import link_scene
from flcav.perception.agents import kind_of
from flcav.releases.checking import RepositorySources, check_release, trust_roots
from flcav.releases.installation import Installed, read_installed, update_vehicle, weights_path

STAGE = "release"
WAIT_S = 1.0  # between two attempts [s]


@dataclass(frozen=True)
class Delivered:
    """The delivery to one vehicle."""

    vehicle: str
    at_s: float | None  # time of arrival on the trace's clock [s]; None: not by its end
    attempts: int
    bytes: int  # on the radio, lost attempts included
    reason: str  # of the last attempt's failure; empty if it arrived


def deliver_release(
    links: RadioLinks,
    vehicles: Sequence[str],
    release: int,
    size_bytes: int,
    settings: NetworkSettings,
    ledger: Ledger,
    task: str = "objects",
    fetched: set[str] | None = None,
) -> tuple[Delivered, ...]:
    """Return the deliveries of a release of `size_bytes` [bytes] to `vehicles`, and enter them in the ledger.

    Downlinks have no budget, but every message is entered, including lost attempts. fetched: roadside units that have
    the files already, changed in place; None: none has.
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


@dataclass(frozen=True)
class FleetDrive:
    """A recorded drive: one vehicle in one scene."""

    scene: str
    agent: str

    @property
    def name(self) -> str:
        """Return the drive's name."""
        return f"{self.scene}/{self.agent}"


@dataclass(frozen=True)
class SimulatedRadio:
    """The radio network of a recording: roadside units, and the links of its scenes, cached by scene."""

    data: Dataset
    settings: NetworkSettings
    poles: tuple[int, ...]
    seed: int
    known: dict[str, RadioLinks] = field(default_factory=dict)

    def links(self, scene: str) -> RadioLinks:
        """Return the links of a scene."""
        if scene not in self.known:
            self.known[scene] = link_scene(self.data, self.settings.radio, self.poles, scene, self.seed).links
        return self.known[scene]


@dataclass(frozen=True)
class SimulatedFleet:
    """A simulated fleet of vehicles, with a folder per vehicle."""

    folder: Path
    names: tuple[str, ...]
    drives: tuple[FleetDrive, ...]
    task: str

    def drive_of(self, vehicle: str, turn: int) -> FleetDrive:
        """Return the recorded drive of a vehicle at a turn."""
        return self.drives[(self.names.index(vehicle) + turn) % len(self.drives)]

    def installed(self, vehicle: str) -> Installed:
        """Return the driving network of a vehicle."""
        found = read_installed(self.folder / vehicle)
        assert found is not None
        return found


def list_drives(data: Dataset) -> tuple[FleetDrive, ...]:
    """Return the drives of a recording; raises `InputError` if it has no vehicle."""
    keys = dict.fromkeys((key.scene, key.agent) for key in data.keys if kind_of(key.agent) == "vehicle")
    if not keys:
        raise InputError(f"{data.folder}: has no vehicle that drives")
    return tuple(FleetDrive(scene, agent) for scene, agent in keys)


def build_fleet(
    folder: Path,
    count: int,
    drives: Sequence[FleetDrive],
    roots: tuple[bytes, bytes],
    sources: RepositorySources,
    task: str,
) -> SimulatedFleet:
    """Return a fleet of `count` vehicles in new folders, which trust both roots and have the signed release installed.

    roots: those of the provider and of the customer.
    """
    names = tuple(f"car{number:04d}" for number in range(count))
    first = folder / names[0]
    trust_roots(first, *roots)
    update_vehicle(first, names[0], sources, task)
    for name in names[1:]:
        shutil.copytree(first, folder / name, symlinks=True, copy_function=_copy)
    return SimulatedFleet(folder, names, tuple(drives), task)


def update_over_radio(
    fleet: SimulatedFleet,
    vehicles: Sequence[str],
    turn: int,
    radio: SimulatedRadio,
    sources: RepositorySources,
    ledger: Ledger,
    fetched: set[str],
) -> list[Delivered]:
    """Let vehicles download and install their signed release during their drives of a turn; return the deliveries.

    Times of arrival are relative to the start of the drive [s]. Messages are entered in the ledger. fetched: roadside
    units that have the files, changed in place.
    """
    groups: dict[
        tuple[int, str, int, int], dict[str, str]
    ] = {}  # vehicles that download together, by agent of the recording
    for vehicle in vehicles:
        drive = fleet.drive_of(vehicle, turn)
        day = fleet.names.index(vehicle) // len(fleet.drives)
        release, size = _ask(fleet, vehicle, sources)
        groups.setdefault((day, drive.scene, release, size), {})[drive.agent] = vehicle
    found = []
    for (_, scene, release, size), by_agent in groups.items():
        links = radio.links(scene)
        named = replace(links, vehicle=tuple(by_agent.get(agent, agent) for agent in links.vehicle))
        arrived = deliver_release(
            named, [*by_agent.values()], release, size, radio.settings, ledger, fleet.task, fetched
        )
        start = float(links.time_s[0])
        found += [each if each.at_s is None else replace(each, at_s=each.at_s - start) for each in arrived]
    for each in found:
        if each.at_s is not None:
            update_vehicle(fleet.folder / each.vehicle, each.vehicle, sources, fleet.task)
    return found


def _ask(fleet: SimulatedFleet, vehicle: str, sources: RepositorySources) -> tuple[int, int]:
    """Return the release for a vehicle, and the size of its download [bytes], without weights that it has."""
    checked = check_release(fleet.folder / vehicle, vehicle, sources, fleet.task)
    assert checked.approved is not None
    approved = checked.approved
    kept = weights_path(fleet.folder / vehicle, Installed(approved.task, approved.release, approved.weights))
    return approved.release, checked.metadata_bytes + (0 if kept.is_file() else approved.bytes)


def _copy(source: str, target: str) -> str:
    """Copy a file; weights, which are never rewritten, are hard-linked."""
    if source.endswith(".safetensors"):
        os.link(source, target)
        return target
    return str(shutil.copy2(source, target))
