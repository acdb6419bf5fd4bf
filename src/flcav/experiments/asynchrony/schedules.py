"""Schedules of the compared federations, on the same clock: who begins when, and whose updates come when."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flcav.federation.buffered_rounds import Buffers
from flcav.federation.rules import Rules
from flcav.federation.runtimes.metered import Outage
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.network.clock.buffers import BufferTiming, chain_links
from flcav.network.clock.records import RoundTiming
from flcav.network.clock.rounds import NetworkSettings, simulate_rounds
from flcav.network.radio.links import RadioLinks
from flcav.runs.driving import AWAY, Fleet
from flcav.runs.extras.buffered.driving import BufferedFleet

PASSES = 20  # through the scenes, at most, of rounds that wait


@dataclass(frozen=True)
class Rival:
    """A way to federate: its strategy, and whether its rounds are those of fast vehicles alone."""

    strategy: Strategy = FEDAVG
    leaves_slow: bool = False


@dataclass(frozen=True)
class Scheduled:
    """The rounds of a federation by the clock."""

    end_s: tuple[float, ...]  # of each round
    up_bytes: tuple[int, ...]  # of each round, what broke off included
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)
    buffers: Buffers | None = None

    def last_within(self, seconds: float, up_bytes: float) -> int:
        """Return the number of rounds that end within so many seconds, and with no more bytes."""
        sent = np.cumsum(self.up_bytes)
        within = (np.array(self.end_s) <= seconds + 1e-9) & (sent <= up_bytes)
        return int(np.argmin(within)) if not within.all() else len(within)


def schedule_rounds(rival: Rival, fleet: Fleet, scenes: Sequence[RadioLinks], rounds: int) -> Scheduled:
    """Return so many rounds of FedAvg, one after another, each of all vehicles that are asked and there."""
    links, _ = chain_links([*scenes] * PASSES)
    asked = [client for client in fleet.clients if not (rival.leaves_slow and client in fleet.speeds)]
    works = {fleet.work(client).client: fleet.work(client) for client in asked}
    timed = simulate_rounds(links, [works] * rounds, NetworkSettings())
    return Scheduled(
        tuple(each.end_s for each in timed),
        tuple(sum(client.uploaded_bytes for client in each.clients) for each in timed),
        find_outages(fleet, timed),
    )


def find_outages(fleet: Fleet, timed: Sequence[RoundTiming]) -> dict[tuple[int, str], Outage]:
    """Return who is lost in rounds, or not there when one begins."""
    found: dict[tuple[int, str], Outage] = {}
    for each in timed:
        clients = {f"{fleet.region}/{client.client}": client for client in each.clients}
        for name in fleet.clients:
            if name not in clients:
                found[each.round, name] = Outage(AWAY)
            elif clients[name].dropped:
                found[each.round, name] = Outage(clients[name].dropped, clients[name].uploaded_bytes)
    return found


def schedule_buffers(
    strategy: FedBuff, fleet: Fleet, scenes: Sequence[RadioLinks], seconds: float, up_bytes: int
) -> Scheduled:
    """Return the buffers until both so many seconds are over and so many bytes are sent."""
    own = BufferedFleet(fleet, scenes, {})
    clock, timings = own.open_clock(strategy, NetworkSettings()), list[BufferTiming]()
    while not timings or timings[-1].end_s <= seconds or sum(map(_sum_bytes, timings)) <= up_bytes:
        timings.append(clock.fill())
    driven = own.read(Rules(), timings)
    return Scheduled(tuple(each.end_s for each in timings), tuple(map(_sum_bytes, timings)), buffers=driven.buffers)


def _sum_bytes(timing: BufferTiming) -> int:
    return sum(client.uploaded_bytes for client in (*timing.updates, *timing.broken))
