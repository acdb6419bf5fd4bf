"""The radio network of a run's vehicles: clients that complete a round, its duration, and a plan's prediction of both.

Round n of a region is driven in one of the scenes of its training data, in turn, from the scene's first instant. The
roadside units are on the poles of its sensors; a plan, which is made before these are placed, has one unit, on the pole
with most traffic. With measured throughput (`flcav.network.radio.measured`) there are no scenes and no units: the
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

CLOCK = "clock"  # begins the names of the files of rounds on the network, by region
AWAY, TOO_SLOW = "not in the town", "predicted past the deadline"
PATIENT = RoundRules()  # by which a round is predicted: without a deadline


@dataclass(frozen=True)
class DrivenRounds:
    """The rounds of a region on the radio network: rules, lost clients with reasons, and durations [s]."""

    rules: Rules
    outages: Mapping[tuple[int, str], Outage]  # by round, from 1, and client
    records: tuple[RoundTiming, ...]  # on the clock of the region's rounds, from 0 s
    buffers: Buffers | None = None  # of asynchronous rounds: which version each update began with

    @property
    def seconds(self) -> list[float]:
        """Return the duration of each round [s]."""
        return [record.end_s - record.start_s for record in self.records]


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a region in a round: what each downloads, computes and uploads."""

    region: str
    clients: tuple[str, ...]  # "region/vehicle"
    download_bytes: int
    upload_bytes: int
    train_s: float  # of a vehicle of speed 1 in a round
    speeds: Mapping[str, float]  # by client; others have 1

    def work(self, client: str) -> ClientWork:
        """Return the work of a client in a round, by the name of its vehicle in the traffic."""
        vehicle = client.removeprefix(f"{self.region}/")
        return ClientWork(vehicle, self.download_bytes, self.train_s / self.speeds.get(client, 1.0), self.upload_bytes)


def link_scenes(split: Frames, placed: Placed, settings: NetworkSettings, most: int, seed: int) -> list[RadioLinks]:
    """Return the links of the vehicles in the first `most` scenes of a split to the units on a region's chosen poles.

    Without chosen poles, the unit is on the pole with most traffic. Raises `InputError` where there is no pole, and as
    `link_scene`.
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
    """Return settings with the file of measured rates found and its SHA-256 noted, and the wireline as measured.

    The wireline has the lowest mean rate of its measured ones, if there are any. Raises `InputError` where the file is
    missing, or holds no rates.
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

    seeds: of each round, which its clients are drawn by. Under deadline selection without given `seconds`
    those take part whose round is predicted to end in time, with all that are in the town at once. A round goes on
    without the vehicles that it loses, however many they are, unless the rules say how many it needs. Raises
    `InputError` where the vehicles cannot be selected so.
    """
    rules.selection.check_clients(fleet.clients)
    outages: dict[tuple[int, str], Outage] = {}
    records, joins, now = [], dict.fromkeys(fleet.clients, ()), 0.0
    for number, seed in enumerate(seeds, start=1):
        links = scenes[(earlier + number - 1) % len(scenes)]
        begins = float(links.time_s[0]) + (now % links.period_s if links.period_s else 0.0)
        instant = int(np.searchsorted(links.time_s, begins, side="right")) - 1
        present = {name for name, here in zip(links.vehicle, links.present[instant].tolist(), strict=True) if here}
        chosen = rules.selection.choose(fleet.clients, number, seed, earlier)
        outages |= {(number, each): Outage(AWAY) for each in chosen if fleet.work(each).client not in present}
        there = [each for each in chosen if (number, each) not in outages]
        if rules.selection.predicts:
            slow = _find_slow(fleet, links, there, number, rules.selection.deadline_s or 0.0, begins)
            outages |= {(number, each): Outage(TOO_SLOW) for each in slow}
            there = [each for each in there if each not in slow]
            joins |= {each: (*joins[each], number) for each in there}
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
    work = [fleet.work(each) for each in clients]
    return dict(zip(clients, time_round(links, work, number, begins, rules), strict=True))


def _find_slow(
    fleet: Fleet, links: RadioLinks, clients: Sequence[str], number: int, deadline_s: float, begins: float
) -> set[str]:
    """Return the clients whose update is not predicted to arrive within `deadline_s` [s] of the round's start."""
    timings = _time(fleet, links, clients, number, PATIENT, begins)
    return {name for name, t in timings.items() if t.dropped or t.end_s - t.start_s > deadline_s}


@dataclass(frozen=True)
class DrivenStage:
    """The rounds of a stage on the radio network: rules of all regions, lost clients, and durations [s]."""

    rules: Rules
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)  # by edge round, from 1, and client
    seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)  # of each round [s], by server
    buffers: Mapping[str, Buffers] = field(default_factory=dict)  # of asynchronous rounds, by region
    records: Mapping[str, tuple[RoundTiming, ...]] = field(default_factory=dict)  # of the edge rounds, by region


def join_regions(driven: Mapping[str, DrivenRounds], k: int = 1, ways_s: float | None = None) -> DrivenStage:
    """Return the rounds of all regions in a stage together.

    A cloud round is `k` edge rounds of the slowest region, and a model's ways down and up by wireline, which take
    `ways_s` [s]; None: there is no cloud, or no network.
    """
    rules = next(iter(driven.values())).rules
    if len(driven) > 1 and all(each.rules.selection.rule == "planned" for each in driven.values()):
        joins = {name: rounds for each in driven.values() for name, rounds in each.rules.selection.joins.items()}
        rules = rules.model_copy(update={"selection": Selection(rule="planned", joins=joins)})
    seconds = {region: each.seconds for region, each in driven.items()}
    if ways_s is not None:
        rounds = range(0, len(next(iter(seconds.values()))), k)
        seconds[CLOUD] = [ways_s + max(sum(own[first : first + k]) for own in seconds.values()) for first in rounds]
    outages = {key: outage for each in driven.values() for key, outage in each.outages.items()}
    buffers = {region: each.buffers for region, each in driven.items() if each.buffers is not None}
    return DrivenStage(rules, outages, seconds, buffers, {region: each.records for region, each in driven.items()})


def link_drive(
    region: str, drive: Frames, settings: NetworkSettings, range_m: float, seed: int, recorded: bool
) -> list[RadioLinks]:
    """Return the links of the vehicles in the scenes of a drive to a unit on the pole with most traffic.

    Traffic counts within `range_m` [m]. Of `recorded` data the poles are those that it was recorded from. Raises
    `InputError` where there is none, and as `link_scene`.
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
    """Return the mean rate of the uplink [Mbit/s] of each vehicle of a drive, "region/vehicle", over all its scenes.

    Each vehicle has the whole band; where it is not in the town, its rate is 0. See `link_drive`.
    """
    if settings.throughput is not None:
        measured = load_throughput(settings.throughput, settings.throughput_sha256)
        vehicles = dict.fromkeys(f"{region}/{drive.data.keys[i].agent}" for i in drive.vehicles)
        return {name: measured.mean_mbps(name) for name in vehicles}
    rates = dict[str, list[float]]()
    for links in link_drive(region, drive, settings, range_m, seed, recorded=drive.data.town() is None):
        for vehicle, mean in zip(links.vehicle, links.rate_bps[:, :, 0].mean(axis=0) / 1e6, strict=True):
            rates.setdefault(f"{region}/{vehicle}", []).append(float(mean))
    return {name: float(np.mean(each)) for name, each in rates.items()}


def predict_air_s(scenes: Sequence[RadioLinks], download_bytes: int, upload_bytes: int) -> float | None:
    """Return the mean time [s] in which a vehicle downloads and uploads so many bytes; None where none gets through.

    In each scene all that are in the town begin at its first instant, and share the band.
    """
    spent = []
    for links in scenes:
        present = [name for name, here in zip(links.vehicle, links.present[0].tolist(), strict=True) if here]
        if present and len(links.time_s) > 1:
            work = [ClientWork(name, download_bytes, 0.0, upload_bytes) for name in present]
            timings = time_round(links, work, 1, float(links.time_s[0]), RoundRules())
            spent += [timing.end_s - timing.start_s for timing in timings if not timing.dropped]
    return float(np.mean(spent)) if spent else None
