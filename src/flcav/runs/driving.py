"""The radio network of a run's vehicles: clients that complete a round, its duration, and a plan's prediction of both.

Round n of a region is simulated in one of the scenes of its training data, in turn, from the scene's first instant. The
roadside units are on the poles of its sensors; a plan, which is made before these are placed, assumes one unit, on the
pole with most traffic. With measured throughput (`flcav.network.radio.measured`) there are no scenes and no units: the
rounds of a stage follow one another on the clock of the measurement, which repeats.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import InputError
from flcav.federation.links.metered import Outage
from flcav.federation.modes.buffered import Buffers
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.network.clock.records import ClientTiming, ClientWork, RoundTiming
from flcav.network.clock.rounds import NetworkSettings, RoundRules, time_round
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.measured import link_measured, load_throughput
from flcav.network.radio.recorded import link_scene
from flcav.runs.frames import Frames
from flcav.runs.poles import find_sites, read_traces
from flcav.runs.recipe import CLOUD, find_path
from flcav.runs.results.plans import Placed
from flcav.storage.files import sha256
from flcav.world.map.census import measure_traffic_density

CLOCK = "clock"  # prefix of the names of files with the times of rounds on the network, by region
AWAY, TOO_SLOW = "not in the town", "predicted past the deadline"
PATIENT = RoundRules()  # rules by which a round is predicted: without a deadline


@dataclass(frozen=True)
class DrivenRounds:
    """The rounds of a region on the radio network: rules, lost clients with reasons, and durations [s]."""

    rules: Rules
    outages: Mapping[tuple[int, str], Outage]  # by round, from 1, and client
    records: tuple[RoundTiming, ...]  # on the clock of the region's rounds, from 0 s
    buffers: Buffers | None = None  # of asynchronous rounds: the version that an update began with

    @property
    def seconds(self) -> list[float]:
        """The durations of the rounds [s]."""
        return [record.end_s - record.start_s for record in self.records]


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a region in a round: what a vehicle downloads, computes and uploads."""

    region: str
    clients: tuple[str, ...]  # "region/vehicle"
    download_bytes: int  # message to a vehicle in a round [bytes]
    upload_bytes: int  # message from a vehicle in a round [bytes]
    train_s: float  # training time of a vehicle of speed 1 in a round [s]
    speeds: Mapping[str, float]  # relative computing speeds, by client; others have 1

    def work(self, client: str) -> ClientWork:
        """Return the work of a client in a round, under the name of its vehicle in the traffic."""
        vehicle = client.removeprefix(f"{self.region}/")
        return ClientWork(vehicle, self.download_bytes, self.train_s / self.speeds.get(client, 1.0), self.upload_bytes)


def link_scenes(split: Frames, placed: Placed, settings: NetworkSettings, most: int, seed: int) -> list[RadioLinks]:
    """Return the radio links between vehicles and roadside units in the first `most` scenes of a split.

    The units are on the region's chosen poles; without any, one is on the pole with most traffic. Raises `InputError`
    where there is no pole, and as `link_scene`.
    """
    scenes = list(dict.fromkeys(split.data.keys[i].scene for i in split.vehicles))[:most]
    if settings.throughput is not None:
        return [_link_measured(placed.region, split, settings)] * len(scenes)
    if not placed.poles:
        raise InputError(f"federation.network: '{placed.region}' has no poles for roadside units")
    poles = placed.chosen or (placed.densest,)
    return [link_scene(split.data, settings.radio, poles, scene, seed).links for scene in scenes]


def _link_measured(region: str, split: Frames, settings: NetworkSettings) -> RadioLinks:
    """Return the measured links of the vehicles of a split."""
    assert settings.throughput is not None
    vehicles = list(dict.fromkeys(split.data.keys[i].agent for i in split.vehicles))
    measured = load_throughput(settings.throughput, settings.throughput_sha256)
    return link_measured(measured, settings.radio, vehicles, region)


def fix_throughput(settings: NetworkSettings, beside: Path) -> NetworkSettings:
    """Return settings with the absolute path and SHA-256 of the file of measured rates, and the wireline's rate.

    The wireline has the lowest mean rate of the measured wirelines, if there are any. Raises `InputError` where the
    file is missing from the folder `beside`, or holds no rates.
    """
    if settings.throughput is None:
        return settings
    path = find_path(settings.throughput, beside)
    if path is None:
        raise InputError(f"federation.network.throughput: there is no file {settings.throughput!r} in {beside}")
    measured = load_throughput(path.absolute(), settings.throughput_sha256)
    update: dict[str, Any] = {"throughput": str(path.absolute()), "throughput_sha256": sha256(path)}
    if wired := [measured.mean_mbps(name, "wireline") for name in measured.rates["wireline"]]:
        if min(wired) == 0:
            raise InputError(f"{path}: a wireline without any throughput")
        update["wireline"] = settings.wireline.model_copy(update={"rate_mbps": min(wired)})
    return settings.model_copy(update=update)


def drive_rounds(
    fleet: Fleet,
    scenes: Sequence[RadioLinks],
    settings: NetworkSettings,
    rules: Rules,
    seeds: Sequence[int],
    earlier: int,
) -> DrivenRounds:
    """Simulate rounds by `rules` on the radio network, after `earlier` ones in the scenes before.

    `seeds`: one per round, by which its clients are drawn. Under deadline selection without given `seconds` the clients
    of a round are those whose update is predicted to arrive in time while all vehicles in the town transmit. A round
    goes on without the vehicles that it loses, however many, unless the rules require a number. Raises `InputError`
    where the rules cannot select among these vehicles.
    """
    rules.selection.check_clients(fleet.clients)
    outages: dict[tuple[int, str], Outage] = {}
    records = []
    joins = dict.fromkeys(fleet.clients, ())
    now = 0.0  # clock of the region's rounds [s]
    for number, seed in enumerate(seeds, start=1):
        links = scenes[(earlier + number - 1) % len(scenes)]
        # Scenes and the clock of the rounds have different origins: times of the scene are moved by `shift` below.
        begins = float(links.time_s[0]) + (now % links.period_s if links.period_s else 0.0)
        instant = int(np.searchsorted(links.time_s, begins, side="right")) - 1
        present = {name for name, here in zip(links.vehicle, links.present[instant].tolist(), strict=True) if here}
        chosen = rules.selection.choose(fleet.clients, number, seed, earlier)
        outages |= {(number, name): Outage(AWAY) for name in chosen if fleet.work(name).client not in present}
        there = [name for name in chosen if (number, name) not in outages]
        if rules.selection.predicts:
            slow = _find_slow(fleet, links, there, number, rules.selection.deadline_s or 0.0, begins)
            outages |= {(number, name): Outage(TOO_SLOW) for name in slow}
            there = [name for name in there if name not in slow]  # simulated below without the slow ones on the band
            joins |= {name: (*joins[name], number) for name in there}
        timings = _time(fleet, links, there, number, settings.rounds, begins)
        shift = now - begins
        for client, timing in timings.items():
            if timing.dropped:
                outages[number, client] = Outage(timing.dropped, timing.uploaded_bytes)
        clients = tuple(replace(t, start_s=t.start_s + shift, end_s=t.end_s + shift) for t in timings.values())
        ends = max((timing.end_s for timing in clients), default=now)
        records.append(RoundTiming(number, now, ends, 0.0, 0.0, clients))
        now = ends
    selection = Selection(rule="planned", joins=joins) if rules.selection.predicts else rules.selection
    return DrivenRounds(rules.model_copy(update={"selection": selection}), outages, tuple(records))


def _time(
    fleet: Fleet, links: RadioLinks, clients: Sequence[str], number: int, rules: RoundRules, begins: float
) -> dict[str, ClientTiming]:
    if not clients:
        return {}
    work = [fleet.work(client) for client in clients]
    return dict(zip(clients, time_round(links, work, number, begins, rules), strict=True))


def _find_slow(
    fleet: Fleet, links: RadioLinks, clients: Sequence[str], number: int, deadline_s: float, begins: float
) -> set[str]:
    """Return the clients whose update is predicted to arrive later than `deadline_s` [s] after the round's start."""
    timings = _time(fleet, links, clients, number, PATIENT, begins)
    return {name for name, t in timings.items() if t.dropped or t.end_s - t.start_s > deadline_s}


@dataclass(frozen=True)
class DrivenStage:
    """The rounds of a stage on the radio network: rules of all regions, lost clients, and durations [s]."""

    rules: Rules
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)  # by edge round, from 1, and client
    seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)  # durations of the rounds [s], by server
    buffers: Mapping[str, Buffers] = field(default_factory=dict)  # of asynchronous rounds, by region
    records: Mapping[str, tuple[RoundTiming, ...]] = field(default_factory=dict)  # of the edge rounds, by region


def join_regions(driven: Mapping[str, DrivenRounds], k: int = 1, ways_s: float | None = None) -> DrivenStage:
    """Join the rounds of a stage's regions.

    A cloud round takes as long as `k` edge rounds of the slowest region, and the model's transfers down and up by
    wireline, `ways_s` [s]; None: there is no cloud, or no network.
    """
    rules = next(iter(driven.values())).rules
    if len(driven) > 1 and all(drive.rules.selection.rule == "planned" for drive in driven.values()):
        joins = {name: rounds for drive in driven.values() for name, rounds in drive.rules.selection.joins.items()}
        rules = rules.model_copy(update={"selection": Selection(rule="planned", joins=joins)})
    seconds = {region: drive.seconds for region, drive in driven.items()}
    if ways_s is not None:
        rounds = range(0, len(next(iter(seconds.values()))), k)
        seconds[CLOUD] = [ways_s + max(sum(edge[first : first + k]) for edge in seconds.values()) for first in rounds]
    outages = {key: outage for drive in driven.values() for key, outage in drive.outages.items()}
    buffers = {region: drive.buffers for region, drive in driven.items() if drive.buffers is not None}
    return DrivenStage(rules, outages, seconds, buffers, {region: drive.records for region, drive in driven.items()})


def link_drive(
    region: str, drive: Frames, settings: NetworkSettings, range_m: float, seed: int, recorded: bool
) -> list[RadioLinks]:
    """Return the radio links between the vehicles of a drive and a unit on the pole with most traffic, by scene.

    Traffic counts within `range_m` [m] of a pole. The poles of `recorded` data are those that it was recorded from.
    Raises `InputError` where there is none, and as `link_scene`.
    """
    if settings.throughput is not None:
        return [_link_measured(region, drive, settings)]
    sites = find_sites(drive, drive if recorded else None)
    if not len(sites.number):
        raise InputError(f"federation.network: '{region}' has no poles for roadside units")
    actors = measure_traffic_density(sites.position, read_traces(drive.data, drive.vehicles), range_m)
    pole = int(sites.number[int(np.argmax(actors))])
    scenes = dict.fromkeys(drive.data.keys[i].scene for i in drive.vehicles)
    return [link_scene(drive.data, settings.radio, (pole,), scene, seed).links for scene in scenes]


def measure_uplinks(
    region: str, drive: Frames, settings: NetworkSettings, range_m: float, seed: int
) -> dict[str, float]:
    """Return the mean uplink rate [Mbit/s] over all scenes of a drive, by "region/vehicle".

    A vehicle has the whole band; where it is not in the town, its rate is 0. See `link_drive`.
    """
    if settings.throughput is not None:
        measured = load_throughput(settings.throughput, settings.throughput_sha256)
        vehicles = dict.fromkeys(f"{region}/{drive.data.keys[i].agent}" for i in drive.vehicles)
        return {name: measured.mean_mbps(name) for name in vehicles}
    rates = dict[str, list[float]]()
    for links in link_drive(region, drive, settings, range_m, seed, recorded=drive.data.town() is None):
        for vehicle, mean in zip(links.vehicle, links.rate_bps[:, :, 0].mean(axis=0) / 1e6, strict=True):
            rates.setdefault(f"{region}/{vehicle}", []).append(float(mean))
    return {name: float(np.mean(means)) for name, means in rates.items()}


def predict_air_s(scenes: Sequence[RadioLinks], download_bytes: int, upload_bytes: int) -> float | None:
    """Return the mean time [s] in which a vehicle downloads and uploads so many bytes; None where none gets through.

    All vehicles in the town begin at the first instant of a scene, and share the band.
    """
    spent = []
    for links in scenes:
        present = [name for name, here in zip(links.vehicle, links.present[0].tolist(), strict=True) if here]
        if present and len(links.time_s) > 1:
            work = [ClientWork(name, download_bytes, 0.0, upload_bytes) for name in present]
            timings = time_round(links, work, 1, float(links.time_s[0]), RoundRules())
            spent += [timing.end_s - timing.start_s for timing in timings if not timing.dropped]
    return float(np.mean(spent)) if spent else None
