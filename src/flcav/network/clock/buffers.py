"""Clock of buffered asynchronous rounds: clients train at their own pace, and a full buffer ends a round.

Every client downloads the latest version of the weights, trains, uploads, and waits until a buffer with its update is
full. Hence no client trains twice on the same version, and the updates of a buffer are of different clients (the
algorithm of Nguyen et al., AISTATS 2022, leaves that open). A client whose update is lost on the network starts again
as soon as it is in the town and in coverage.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flcav.config import InputError
from flcav.network.clock.records import ClientTiming, ClientWork, RoundTiming
from flcav.network.clock.rounds import TIE, ClientPhases, Phase, RoundRules
from flcav.network.radio.links import RadioLinks

PATIENCE = 10  # number of passes through all scenes, with the longest training each, in which an update has to arrive


@dataclass(frozen=True)
class BufferTiming:
    """A full buffer: time, updates with their versions of the weights, and the attempts that failed meanwhile."""

    number: int  # from 1; the version of the weights after it
    start_s: float  # when the previous buffer was full
    end_s: float
    updates: tuple[ClientTiming, ...]  # in the order in which they arrived
    versions: Mapping[str, int]  # by client, the version of the weights that its update started from
    broken: tuple[ClientTiming, ...]  # failed attempts, possibly several of a client

    def as_round(self) -> RoundTiming:
        """Return the buffer as a round; its clients may have started before the round."""
        return RoundTiming(self.number, self.start_s, self.end_s, 0.0, 0.0, (*self.updates, *self.broken))


def chain_links(scenes: Sequence[RadioLinks]) -> tuple[RadioLinks, float]:
    """Return the links of scenes that follow one another without a gap, and their total duration [s].

    The clock starts at 0 s. A vehicle that is not in a scene is absent in it. Raises `InputError` where every scene has
    a single instant, or the roadside units differ.
    """
    if scenes[0].measured_bps is not None:
        scenes = scenes[:1]  # measured rates repeat by themselves
    names = tuple(dict.fromkeys(name for links in scenes for name in links.vehicle))
    first = scenes[0]
    spans = [float(links.time_s[-1] - links.time_s[0]) for links in scenes]
    if not sum(spans):
        raise InputError("scenes of one instant: vehicles that go on at their own pace need time to pass")
    if any(links.unit != first.unit for links in scenes):
        raise InputError("scenes with other roadside units")
    times, distances, states, losses = [], [], [], []
    for number, links in enumerate(scenes):
        # Without the last instant, which coincides with the first of the next scene.
        times.append(links.time_s[:-1] - links.time_s[0] + sum(spans[:number]))
        shape = (len(links.time_s) - 1, len(names), len(first.unit))
        distance, state, loss = np.full(shape, np.nan), np.full(shape, -1, np.int8), np.full(shape, np.inf)
        columns = [names.index(name) for name in links.vehicle]
        distance[:, columns], state[:, columns] = links.distance_m[:-1], links.state[:-1]
        loss[:, columns] = links.loss_db[:-1]
        distances.append(distance)
        states.append(state)
        losses.append(loss)
    distance, state, loss = (np.concatenate(parts) for parts in (distances, states, losses))
    measured = None if first.measured_bps is None else first.measured_bps[:-1]
    clock = np.concatenate(times)
    return RadioLinks(first.radio, clock, names, first.unit, distance, state, loss, measured), sum(spans)


class BufferClock(ClientPhases):
    """Clock of a region's clients, who train at their own pace and fill buffers; the scenes repeat in order."""

    def __init__(self, scenes: Sequence[RadioLinks], work: Sequence[ClientWork], size: int, rules: RoundRules) -> None:
        """Start at 0 s, with `size` updates in a full buffer; `work` is that of every training of a client.

        Clients that are in no scene are left out. Raises `InputError` as `chain_links`, and where fewer than `size`
        remain.
        """
        links, self._period_s = chain_links(scenes)
        in_scenes = [client_work for client_work in work if client_work.client in links.vehicle]
        if len(in_scenes) < size:
            raise InputError(f"a buffer of {size} updates, and {len(in_scenes)} vehicles on the network")
        super().__init__(links, in_scenes, 0, 0.0, rules)
        self._size, self._version, self._ended_s, self._limit_s = size, 0, 0.0, np.inf
        self._reach = links.rate_bps[:, self.column] > 0  # (T, K, U)
        self._longest_s = PATIENCE * (self._period_s + max(client_work.compute_s for client_work in in_scenes))
        self.phase[:] = Phase.OVER
        self._waits = np.zeros(len(in_scenes), bool)  # (K,) whether an update is in the buffer
        self._begun = np.zeros(len(in_scenes), np.int64)  # (K,) version of the weights that training started from
        self._arrived: list[int] = []  # clients in the order in which their updates arrived
        self._broken: list[ClientTiming] = []

    @property
    def instant(self) -> int:
        """The latest instant of the scenes."""
        return int(np.searchsorted(self.links.time_s, self._phase_s, side="right")) - 1

    @property
    def _phase_s(self) -> float:
        """The time since the start of the current pass through the scenes [s], plus `TIE`."""
        return (self.time_s + TIE) % self._period_s

    @property
    def until_next_s(self) -> float:
        """The time until the next instant, or until the limit of `hold` [s]."""
        n = self.instant
        following = float(self.links.time_s[n + 1]) if n + 1 < len(self.links.time_s) else self._period_s
        return min(following - self._phase_s + TIE, self._limit_s - self.time_s)

    @property
    def ends(self) -> bool:
        """Whether the trace ends: never, since scenes repeat."""
        return False

    def fill(self) -> BufferTiming:
        """Advance the clock until the buffer is full, and return it; raises `InputError` where no update arrives."""
        last_s = self.time_s
        while len(self._arrived) < self._size:
            arrived = len(self._arrived)
            self._step(begin=True)
            last_s = self.time_s if len(self._arrived) > arrived else last_s
            if self.time_s - last_s > self._longest_s:
                raise InputError(f"no vehicle's update arrives within {self._longest_s:g} s on the network")
        full = self._arrived[: self._size]
        self._arrived = self._arrived[self._size :]
        number = self._version + 1
        updates = tuple(replace(self._timing(k), round=number) for k in full)
        versions = {self.work[k].client: int(self._begun[k]) for k in full}
        broken = tuple(replace(timing, round=number) for timing in self._broken)
        buffer = BufferTiming(number, self._ended_s, self.time_s, updates, versions, broken)
        self._version = number
        self._ended_s = self.time_s
        self._broken = []
        self._waits[full] = False
        return buffer

    def hold(self, until_s: float) -> None:
        """Advance the clock to `until_s` [s]: updates arrive, and no client starts before the server has new weights.

        A time in the past has no effect.
        """
        self._limit_s = until_s
        while self.time_s < until_s - TIE:
            self._step(begin=False)
        self._limit_s = np.inf

    def _step(self, *, begin: bool) -> None:
        """Advance the clock to the next event; clients start only with `begin`."""
        under_way = self.phase < Phase.OVER
        self._drop()
        self._broken += [self._timing(k) for k in np.flatnonzero(under_way & (self.phase == Phase.OVER)).tolist()]
        if begin:
            self._begin()
        active = self.phase < Phase.OVER
        if not active.any():
            self.time_s += max(self.until_next_s, 0.0)
            return
        self._advance(active)
        for k in np.flatnonzero(active & (self.phase == Phase.OVER)).tolist():
            self._arrived.append(k)
            self._waits[k] = True

    def _begin(self) -> None:
        """Start the clients that neither train nor wait, and are in the town and in coverage of the nearest unit."""
        n = self.instant
        distance = np.nan_to_num(self.links.distance_m[n, self.column], nan=np.inf)
        nearest = distance.argmin(axis=1)
        here = self.links.present[n, self.column] & self._reach[n, np.arange(len(self.work)), nearest]
        rows = np.flatnonzero((self.phase == Phase.OVER) & ~self._waits & here)
        self.phase[rows], self.start_s[rows], self.server[rows] = Phase.DOWNLOAD, self.time_s, nearest[rows]
        self.left[rows], self.spent[rows], self.stalled_since[rows] = self.amount[rows], 0.0, np.inf
        self._begun[rows] = self._version
        for k in rows.tolist():
            self.dropped[k] = ""
