"""Buffered asynchronous rounds of a run's vehicles on the radio network: the schedule that federations follow.

The scenes of a region's training data follow one another without a gap, and repeat. Stage III is asynchronous below
and synchronous above: a region's edge server waits, after its buffers of a cloud round, until the slowest region's are
full and the models have gone up and down by wireline. Meanwhile vehicles go on, and none begins.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from flcav.federation.buffered_rounds import BrokenUpdate, BufferedRound, Buffers
from flcav.federation.rules import Rules
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.network.clock.buffers import BufferClock, BufferTiming
from flcav.network.clock.records import ClientTiming
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.radio.links import RadioLinks
from flcav.runs.radio.driving import DrivenCloud, DrivenRounds, Fleet
from flcav.runs.recipe import CLOUD


@dataclass(frozen=True)
class BufferedFleet:
    """The vehicles of a region that fill buffers: their work, the scenes that they drive in, and rounds before."""

    fleet: Fleet
    scenes: Sequence[RadioLinks]
    before: Mapping[str, int]  # in how many rounds each client took part

    def open_clock(self, strategy: FedBuff, settings: NetworkSettings) -> BufferClock:
        """Return the clock of the region's buffers."""
        work = [self.fleet.work(client) for client in self.fleet.clients]
        return BufferClock(self.scenes, work, strategy.buffer, settings.rounds)

    def read(self, rules: Rules, timings: Sequence[BufferTiming]) -> DrivenRounds:
        """Return the rounds of these buffers."""

        def named(timing: ClientTiming) -> ClientTiming:
            return replace(timing, client=f"{self.fleet.region}/{timing.client}")

        rounds = []
        for each in timings:
            broken = tuple(
                BrokenUpdate(own.client, own.dropped, own.downloaded_bytes, own.uploaded_bytes)
                for own in map(named, each.broken)
            )
            versions = {f"{self.fleet.region}/{vehicle}": version for vehicle, version in each.versions.items()}
            rounds.append(BufferedRound(versions, broken))
        records = tuple(each.as_round() for each in timings)
        return DrivenRounds(rules, {}, records, Buffers(tuple(rounds), self.before))


def drive_buffers(
    fleet: BufferedFleet, strategy: FedBuff, settings: NetworkSettings, rules: Rules, rounds: int
) -> DrivenRounds:
    """Return so many buffered rounds of a region; raises `InputError` as `BufferClock`."""
    clock = fleet.open_clock(strategy, settings)
    return fleet.read(rules, [clock.fill() for _ in range(rounds)])


def drive_cloud_buffers(
    fleets: Mapping[str, BufferedFleet],
    strategy: FedBuff,
    settings: NetworkSettings,
    rules: Rules,
    each: Mapping[str, int],
    cloud_rounds: int,
    model_bytes: int,
) -> tuple[dict[str, DrivenRounds], DrivenCloud]:
    """Return the buffered rounds of stage III by region, and the cloud's.

    Args:
        fleets: vehicles by region.
        strategy: of the regions.
        settings: of radio, wireline and the rounds of vehicles.
        rules: of all regions.
        each: number of buffers of a region in a cloud round.
        cloud_rounds: number of cloud rounds.
        model_bytes: size of what an edge server and the cloud send each other.
    """
    clocks = {region: own.open_clock(strategy, settings) for region, own in fleets.items()}
    timings: dict[str, list[BufferTiming]] = {region: [] for region in fleets}
    ways, ended, seconds = 2 * settings.wireline.seconds(model_bytes), 0.0, []
    for _ in range(cloud_rounds):
        for region, clock in clocks.items():
            timings[region] += [clock.fill() for _ in range(each[region])]
        ends = max((own[-1].end_s for own in timings.values() if own), default=ended) + ways
        for clock in clocks.values():
            clock.hold(ends)
        seconds.append(ends - ended)
        ended = ends
    driven = {region: own.read(rules, timings[region]) for region, own in fleets.items()}
    took = {region: own.seconds for region, own in driven.items()}
    buffers = {region: own.buffers for region, own in driven.items() if own.buffers is not None}
    return driven, DrivenCloud(rules, {}, {**took, CLOUD: seconds}, buffers)
