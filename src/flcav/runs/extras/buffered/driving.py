"""Buffered asynchronous rounds of a run's vehicles on the radio network: the schedule that federations follow.

The scenes of a region's training data follow one another without a gap, and repeat. Stage III is asynchronous among
vehicles and synchronous among edge servers: after its buffers of a cloud round, an edge server waits until those of the
slowest region are full and the models have been transferred up and down by wireline. Meanwhile vehicles continue their
work, but none begins anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from flcav.config import InputError
from flcav.federation.modes.buffered import BrokenUpdate, Buffers, FilledBuffer, count_participations
from flcav.federation.rules import Rules
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.network.clock.buffers import BufferClock, BufferTiming
from flcav.network.clock.records import ClientTiming
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.radio.links import RadioLinks
from flcav.runs.arms import Setting, plans_joiners
from flcav.runs.driving import DrivenRounds, DrivenStage, Fleet, join_regions
from flcav.runs.engine import Work
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import CLOUD, RunRecipe
from flcav.runs.results.training import StageResult
from flcav.runs.stages.federating import StageSettings
from flcav.runs.stages.regions import link_stage_scenes, open_region_fleet, save_clock
from flcav.runs.stages.rounds import RegionStart, StageFederation
from flcav.runs.stages.settings import FederationSettings, RegionInputs
from flcav.runs.training.learning import Learning

ALL_SCENES = 10**6  # more than any dataset has


@dataclass(frozen=True)
class BufferedFleet:
    """The vehicles of a region that fill buffers: their work, the scenes in which they drive, and earlier rounds."""

    fleet: Fleet
    scenes: Sequence[RadioLinks]
    before: Mapping[str, int]  # number of earlier rounds with updates, by client

    def open_clock(self, strategy: FedBuff, settings: NetworkSettings) -> BufferClock:
        """Return the simulated clock of the region's buffers."""
        work = [self.fleet.work(client) for client in self.fleet.clients]
        return BufferClock(self.scenes, work, strategy.buffer, settings.rounds)

    def read(self, rules: Rules, timings: Sequence[BufferTiming]) -> DrivenRounds:
        """Return the rounds from the simulated times of their buffers."""

        def named(timing: ClientTiming) -> ClientTiming:
            return replace(timing, client=f"{self.fleet.region}/{timing.client}")

        rounds = []
        for filled in timings:
            broken = tuple(
                BrokenUpdate(update.client, update.dropped, update.downloaded_bytes, update.uploaded_bytes)
                for update in map(named, filled.broken)
            )
            versions = {f"{self.fleet.region}/{vehicle}": version for vehicle, version in filled.versions.items()}
            rounds.append(FilledBuffer(versions, broken))
        records = tuple(filled.as_round() for filled in timings)
        return DrivenRounds(rules, {}, records, Buffers(tuple(rounds), self.before))


def drive_buffers(
    fleets: Mapping[str, BufferedFleet],
    strategy: FedBuff,
    settings: NetworkSettings,
    rules: Rules,
    each: Mapping[str, int],
    cloud_rounds: int = 1,
    ways_s: float | None = None,
) -> tuple[dict[str, DrivenRounds], DrivenStage]:
    """Simulate the buffered rounds of a stage; return them by region, and joined. Raises `InputError` as `BufferClock`.

    Args:
        fleets: vehicles by region.
        strategy: of the regions' edge servers.
        settings: of the radio and of the vehicles' rounds.
        rules: of all regions.
        each: number of buffers in a cloud round, by region.
        cloud_rounds: number of cloud rounds.
        ways_s: time of a model's transfers down and up by wireline [s]; None: there is no cloud.
    """
    clocks = {region: fleet.open_clock(strategy, settings) for region, fleet in fleets.items()}
    timings: dict[str, list[BufferTiming]] = {region: [] for region in fleets}
    ended = 0.0
    seconds = list[float]()
    for _ in range(cloud_rounds):
        for region, clock in clocks.items():
            timings[region] += [clock.fill() for _ in range(each[region])]
        ends = max((filled[-1].end_s for filled in timings.values() if filled), default=ended) + (ways_s or 0.0)
        for clock in clocks.values():
            clock.hold(ends)
        seconds.append(ends - ended)
        ended = ends
    driven = {region: fleet.read(rules, timings[region]) for region, fleet in fleets.items()}
    joined = join_regions(driven)
    return driven, joined if ways_s is None else replace(joined, seconds={**joined.seconds, CLOUD: seconds})


def count_buffers(
    strategy: Strategy, rounds: int, starts: Mapping[str, RegionStart], cloud: bool
) -> tuple[int, Mapping[str, RegionStart]]:
    """Convert rounds to buffers that hold as many updates; return their number, and the regions with theirs.

    In a cloud round a region fills at least one. Raises `InputError` where a region has fewer vehicles than a buffer
    has updates.
    """
    if not isinstance(strategy, FedBuff):
        return rounds, starts
    for region, start in starts.items():
        strategy.check_buffer(len(start.clients))
        if cloud:
            k = max(strategy.count_rounds(start.edge_rounds, len(start.clients)), 1)
            starts = {**starts, region: replace(start, edge_rounds=k)}
        else:
            rounds = strategy.count_rounds(rounds, len(start.clients))
    return rounds, starts


def drive_stage(
    work: Work, settings: StageSettings, federation: StageFederation, ways_s: float | None
) -> DrivenStage | None:
    """Simulate the buffered rounds of a stage, and write their times; None for another strategy or without a network.

    `ways_s`: time of a model's transfers down and up by wireline [s]; None: there is no cloud.
    """
    strategy = federation.strategies.edge
    network = settings.federation.network
    if not isinstance(strategy, FedBuff) or network is None:
        return None
    fleets = {
        region: open_buffered_fleet(work, settings, federation.learning, settings.regions[region], [*start.clients])
        for region, start in federation.regions.items()
    }
    rounds = federation.schedule.rounds
    counts = {name: rounds if ways_s is None else start.edge_rounds for name, start in federation.regions.items()}
    times = 1 if ways_s is None else rounds
    driven, stage = drive_buffers(fleets, strategy, network, settings.federation, counts, times, ways_s)
    for region, regional in driven.items():
        save_clock(regional, work, region)
    return stage


def open_buffered_fleet(
    work: Work, settings: FederationSettings, learning: Learning, inputs: RegionInputs, clients: Sequence[str]
) -> BufferedFleet:
    """Return the vehicles of a region that fill buffers, in all scenes of its training data."""
    network = settings.federation.network
    before = ()
    assert network is not None  # see `check_buffers`
    if inputs.edge is not None:
        before = StageResult.load(work.inputs[inputs.edge]).records or ()
    scenes = link_stage_scenes(work, inputs, network, ALL_SCENES, learning.seed)
    took_part = count_participations([(record.clients, [*record.failed]) for record in before])
    return BufferedFleet(open_region_fleet(settings, learning, inputs.region, clients), scenes, took_part)


def check_buffers(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` if an arm has buffers without a network, or with a setting that needs synchronous rounds."""
    if not isinstance(strategy, FedBuff):
        return
    if setting.federation.network is None:
        raise InputError("strategy fedbuff: vehicles go on at their own pace, by the clock of 'federation.network'")
    if plans_joiners(recipe, setting):
        raise InputError("strategy fedbuff: nobody joins rounds by a plan; leave out horizon_s")
    if any(LABEL_SOURCES[kind].averaged for kind in setting.labels.values()):
        raise InputError("strategy fedbuff: labels 'road-average' are made anew before a round that all begin together")
