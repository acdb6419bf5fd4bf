"""Comparison of asynchronous and synchronous rounds with stragglers, at equal uplink and at equal time.

Ten vehicles drive through all weathers, as in `federation/drives.py`, linked by radio to one unit on the pole with the
most traffic; three of them, drawn for each seed, train eight times as long. All methods have the same initial weights,
links and stragglers. They are scored at equal megabytes of uplink, those of `ROUNDS` rounds with all vehicles, and at
equal seconds, those of the same rounds of FedAvg.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.experiments.comparison import Differences, describe_differences, tabulate_verdicts
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.links.in_process import update_bytes
from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import Schedule, federate
from flcav.federation.modes.buffered import Buffers
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import Trainable, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.clock.buffers import BufferTiming, chain_links
from flcav.network.clock.records import RoundTiming
from flcav.network.clock.rounds import NetworkSettings, simulate_rounds
from flcav.network.ledger import BYTES_PER_MB, Ledger, LinkMegabytes
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import link_scene
from flcav.perception.weather.task import WEATHER
from flcav.report import style
from flcav.reproductions.federation.drives import (
    Drives,
    Vehicle,
    average_pictures,
    draw_head,
    find_right,
    record_drives,
)
from flcav.runs.driving import AWAY, Fleet
from flcav.runs.extras.buffered.driving import BufferedFleet
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import Stragglers, draw_stragglers
from flcav.statistics.seeds import MeanOverSeeds
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.map.census import measure_traffic_density

PASSES = 20  # greatest number of passes through the scenes in synchronous rounds


@dataclass(frozen=True)
class Rival:
    """A method to compare: its strategy, and whether slow vehicles are left out."""

    strategy: Strategy = FEDAVG
    leaves_slow: bool = False


@dataclass(frozen=True)
class Scheduled:
    """The timed rounds of a federation."""

    end_s: tuple[float, ...]  # of each round
    up_bytes: tuple[int, ...]  # of each round, interrupted updates included
    outages: Mapping[tuple[int, str], Outage] = field(default_factory=dict)
    buffers: Buffers | None = None

    def last_within(self, seconds: float, up_bytes: float) -> int:
        """Return the number of rounds that end within `seconds` [s] and `up_bytes` bytes of uplink."""
        sent = np.cumsum(self.up_bytes)
        within = (np.array(self.end_s) <= seconds + 1e-9) & (sent <= up_bytes)
        return int(np.argmin(within)) if not within.all() else len(within)


def schedule_rounds(rival: Rival, fleet: Fleet, scenes: Sequence[RadioLinks], rounds: int) -> Scheduled:
    """Return consecutive rounds of FedAvg with all vehicles that are called and present."""
    links, _ = chain_links([*scenes] * PASSES)
    called = [client for client in fleet.clients if not (rival.leaves_slow and client in fleet.speeds)]
    works = {fleet.work(client).client: fleet.work(client) for client in called}
    timed = simulate_rounds(links, [works] * rounds, NetworkSettings())
    return Scheduled(
        tuple(round_.end_s for round_ in timed),
        tuple(sum(client.uploaded_bytes for client in round_.clients) for round_ in timed),
        find_outages(fleet, timed),
    )


def find_outages(fleet: Fleet, timed: Sequence[RoundTiming]) -> dict[tuple[int, str], Outage]:
    """Return the outages by round and client: lost during a round, or absent at its start."""
    outages: dict[tuple[int, str], Outage] = {}
    for round_ in timed:
        clients = {f"{fleet.region}/{client.client}": client for client in round_.clients}
        for name in fleet.clients:
            if name not in clients:
                outages[round_.round, name] = Outage(AWAY)
            elif clients[name].dropped:
                outages[round_.round, name] = Outage(clients[name].dropped, clients[name].uploaded_bytes)
    return outages


def schedule_buffers(
    strategy: FedBuff, fleet: Fleet, scenes: Sequence[RadioLinks], seconds: float, up_bytes: int
) -> Scheduled:
    """Return the buffers until `seconds` [s] are over and `up_bytes` bytes are sent, whichever is later."""
    buffered = BufferedFleet(fleet, scenes, {})
    clock = buffered.open_clock(strategy, NetworkSettings())
    timings = list[BufferTiming]()
    while not timings or timings[-1].end_s <= seconds or sum(map(_sum_bytes, timings)) <= up_bytes:
        timings.append(clock.fill())
    buffers = buffered.read(Rules(), timings).buffers
    return Scheduled(tuple(timing.end_s for timing in timings), tuple(map(_sum_bytes, timings)), buffers=buffers)


def _sum_bytes(timing: BufferTiming) -> int:
    return sum(client.uploaded_bytes for client in (*timing.updates, *timing.broken))


ROUNDS, STEPS, LEARNING_RATE, TRAIN_S = 4, 5, 0.05, 1.0
SCENES = 4  # consecutive scenes, which repeat
STRAGGLERS = Stragglers(share=0.3, slower=8)
RARE = (6, 7)  # classes of weather that only stragglers see, in the second setting
WAITS = "FedAvg, waits for all"
RIVALS: Mapping[str, Rival] = {
    WAITS: Rival(),
    "FedAvg, fast vehicles alone": Rival(leaves_slow=True),
    "FedBuff, buffer 2": Rival(FedBuff(2)),
    "FedBuff, buffer 5": Rival(FedBuff(5)),
    "FedBuff, buffer 5, no discount": Rival(FedBuff(5, exponent=0.0)),
}
ALIKE, UNLIKE = "vehicles alike", "stragglers alone see two weathers"
SETTINGS = (ALIKE, UNLIKE)
MEGABYTES, SECONDS = "equal megabytes", "equal seconds"
MEASURES = (MEGABYTES, SECONDS)
REGION = "ring"


@dataclass(frozen=True)
class Trajectory:
    """A federation with one seed: time, uplink and accuracy on the test drives after each round."""

    seconds: tuple[float, ...]  # [s]
    up_mb: tuple[float, ...]  # cumulated [MB]
    accuracy: tuple[float, ...]
    updates: int  # number of updates combined within the equal seconds
    staleness: float  # their mean
    at: Mapping[str, float]  # accuracy at the equal megabytes and at the equal seconds
    took: Mapping[str, float]  # seconds at the equal megabytes, megabytes at the equal seconds


@dataclass(frozen=True)
class AsynchronyResult(Record):
    """Results by setting: trajectories by seed and method, means over seeds, and differences to FedAvg with all."""

    pictures: int  # number in the test
    scenes: int
    stragglers: Mapping[str, tuple[str, ...]]  # by seed
    trajectories: Mapping[str, Mapping[str, Mapping[str, Trajectory]]]  # by setting, seed and rival
    accuracy: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by setting, measure and rival
    differences: Differences
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the differences in words."""
        return describe_differences(self.differences, "waiting")


def compare_asynchrony(
    out: Path, seeds: int, progress: Report = ignore_progress
) -> tuple[AsynchronyResult, dict[str, bytes]]:
    """Record the drives to `out`, federate by each setting, seed and method, and return results and a picture."""
    drives = record_drives(out, progress)
    scenes = Dataset.open(out / "train")
    right: dict[tuple[str, str, str], list[NDArray[np.float64]]] = {}
    found: dict[str, dict[str, dict[str, Trajectory]]] = {setting: {} for setting in SETTINGS}
    drawn: dict[str, tuple[str, ...]] = {}
    total, done = seeds * len(SETTINGS) * len(RIVALS), 0
    for seed in range(1, seeds + 1):
        fleet, links = open_fleet(drives, seed), link_drives(scenes, seed)
        drawn[str(seed)] = tuple(name.removeprefix(f"{REGION}/") for name in fleet.speeds)
        scheduled = schedule_all(fleet, links)
        for setting in SETTINGS:
            clients = give_pictures(drives, fleet, setting)
            by_rival = found[setting].setdefault(str(seed), {})
            for name, rival in RIVALS.items():
                by_rival[name], correct = follow(rival, scheduled[name], scheduled[WAITS], clients, drives, seed)
                for measure, values in correct.items():
                    right.setdefault((setting, measure, name), []).append(values)
                done += 1
                progress(done, total, f"seed {seed}, {setting}, {name}")
    results = summarise(drives, drawn, found, right)
    return results, {"asynchrony.png": style.png(draw_trajectories(results.trajectories, tuple(RIVALS)))}


def open_fleet(drives: Drives, seed: int) -> Fleet:
    """Return the fleet, with stragglers drawn by `seed`."""
    size = update_bytes(draw_head(seed))
    slow = draw_stragglers(STRAGGLERS, [*drives.vehicles], seed, REGION)
    clients = tuple(f"{REGION}/{name}" for name in drives.vehicles)
    return Fleet(REGION, clients, size, size, TRAIN_S, {f"{REGION}/{name}": speed for name, speed in slow.items()})


def link_drives(data: Dataset, seed: int) -> list[RadioLinks]:
    """Return the radio links in the first `SCENES` scenes to a unit on the pole with the most traffic."""
    town = data.town()
    assert town is not None  # since the package recorded it
    names = list(dict.fromkeys(key.scene for key in data.keys))[:SCENES]
    traces = [trace for name in names if (trace := data.trace(name)) is not None]
    pole = int(town.poles.id[int(np.argmax(measure_traffic_density(town.poles.position, traces, 40.0)))])
    return [link_scene(data, Radio(), (pole,), name, seed).links for name in names]


def schedule_all(fleet: Fleet, links: list[RadioLinks]) -> dict[str, Scheduled]:
    """Return the rounds of every method, up to the time and the bytes of FedAvg with all vehicles."""
    waits = schedule_rounds(RIVALS[WAITS], fleet, links, ROUNDS)
    until_s = waits.end_s[-1]
    sent = sum(waits.up_bytes)
    schedules = {WAITS: waits}
    for name, rival in RIVALS.items():
        if isinstance(rival.strategy, FedBuff):
            schedules[name] = schedule_buffers(rival.strategy, fleet, links, until_s, sent)
        elif name != WAITS:
            rounds, schedule = ROUNDS, waits
            while schedule.end_s[-1] <= until_s or sum(schedule.up_bytes) <= sent:
                schedule = schedule_rounds(rival, fleet, links, rounds := rounds + ROUNDS)
            schedules[name] = schedule
    return schedules


def give_pictures(drives: Drives, fleet: Fleet, setting: str) -> dict[str, Trainable]:
    """Return the vehicles as clients; in the setting `UNLIKE`, fast vehicles lack the pictures of `RARE`."""
    clients: dict[str, Trainable] = {}
    for name in fleet.clients:
        seen = drives.vehicles[name.removeprefix(f"{REGION}/")]
        if setting == UNLIKE and name not in fleet.speeds:
            kept = ~np.isin(seen.labels, RARE)
            scenes = tuple(scene for scene, keep in zip(seen.scenes, kept.tolist(), strict=True) if keep)
            seen = replace(seen, features=seen.features[kept], labels=seen.labels[kept], scenes=scenes)
        clients[name] = Vehicle(seen)
    return clients


def follow(
    rival: Rival, schedule: Scheduled, waits: Scheduled, clients: Mapping[str, Trainable], drives: Drives, seed: int
) -> tuple[Trajectory, dict[str, NDArray[np.float64]]]:
    """Run a federation by its schedule; return it, and the correct pictures (N,) at equal megabytes and seconds."""
    start, rounds = draw_head(seed), len(schedule.end_s)
    reached: list[Weights] = [start]
    book = Ledger(LinkMegabytes(1e6, 0.0))
    federate(
        clients,
        start,
        Schedule(rounds, STEPS, LEARNING_RATE, LEARNING_RATE, seed),
        Account(book, "edge", WEATHER.name, "wireless", schedule.outages),
        strategy=rival.strategy,
        buffers=schedule.buffers,
        on_round=lambda round_, weights, loss: reached.append(weights),
    )
    right = [find_right(weights, drives.test) for weights in reached]
    sent = np.cumsum([sum(e.bytes for e in book if (e.direction, e.round) == ("up", n + 1)) for n in range(rounds)])
    ends = {
        MEGABYTES: schedule.last_within(np.inf, sum(waits.up_bytes)),
        SECONDS: schedule.last_within(waits.end_s[-1], np.inf),
    }
    stale = [0] * (len(clients) * ends[SECONDS])
    if schedule.buffers is not None:
        counted = enumerate(schedule.buffers.rounds[: ends[SECONDS]])
        stale = [number - version for number, buffer in counted for version in buffer.versions.values()]
    elif schedule.outages:
        stale = stale[: len(stale) - sum(number <= ends[SECONDS] for number, _ in schedule.outages)]
    trajectory = Trajectory(
        seconds=(0.0, *(round(end_s, 3) for end_s in schedule.end_s)),
        up_mb=(0.0, *np.round(sent / BYTES_PER_MB, 4).tolist()),
        accuracy=tuple(round(float(correct.mean()), 5) for correct in right),
        updates=len(stale),
        staleness=float(np.mean(stale)) if stale else 0.0,
        at={measure: float(right[end].mean()) for measure, end in ends.items()},
        took={
            MEGABYTES: schedule.end_s[ends[MEGABYTES] - 1] if ends[MEGABYTES] else 0.0,
            SECONDS: float(sent[ends[SECONDS] - 1]) / BYTES_PER_MB if ends[SECONDS] else 0.0,
        },
    )
    return trajectory, {measure: right[end].astype(float) for measure, end in ends.items()}


def summarise(
    drives: Drives,
    drawn: Mapping[str, tuple[str, ...]],
    found: Mapping[str, Mapping[str, Mapping[str, Trajectory]]],
    right: Mapping[tuple[str, str, str], list[NDArray[np.float64]]],
) -> AsynchronyResult:
    """Return the means over seeds; these share the scenes of the test."""

    def difference(setting: str, measure: str, name: str) -> MeanOverSeeds:
        pairs = zip(right[setting, measure, name], right[setting, measure, WAITS], strict=True)
        return average_pictures(drives.test, [one - other for one, other in pairs], share=False)

    return AsynchronyResult(
        pictures=len(drives.test.scenes),
        scenes=len(set(drives.test.scenes)),
        stragglers=drawn,
        trajectories=found,
        accuracy={
            s: {m: {n: average_pictures(drives.test, right[s, m, n], share=True) for n in RIVALS} for m in MEASURES}
            for s in SETTINGS
        },
        differences={
            s: {m: {n: difference(s, m, n) for n in RIVALS if n != WAITS} for m in MEASURES} for s in SETTINGS
        },
        provenance=provenance(),
    )


def asynchrony_tables(results: AsynchronyResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, differences."""
    accuracy: list[list[str]] = []
    claims: dict[tuple[str, ...], MeanOverSeeds] = {}
    for setting in SETTINGS:
        of_setting = results.accuracy[setting]
        for rival in RIVALS:
            by_seed = [seed[rival] for seed in results.trajectories[setting].values()]
            means = [of_setting[measure][rival].describe() for measure in MEASURES]
            took = [f"{np.mean([one.took[measure] for one in by_seed]):.2f}" for measure in (MEGABYTES, SECONDS)]
            updates = float(np.mean([one.updates for one in by_seed]))
            stale = float(np.mean([one.staleness for one in by_seed]))
            rest = [means[0], took[0], means[1], took[1], f"{updates:.0f}", f"{stale:.2f}"]
            accuracy.append([setting, rival, *rest])
            for measure in MEASURES if rival != WAITS else ():
                claims[setting, measure, rival] = results.differences[setting][measure][rival]
    heads = (
        f"vehicles, {len(results.stragglers)} seeds",
        "rounds",
        "accuracy at equal megabytes",
        "s by then",
        "accuracy at equal seconds",
        "MB up by then",
        "updates by then",
        "their staleness",
    )
    compared = tabulate_verdicts(("vehicles", "at", "rounds"), "accuracy - that of waiting", claims)
    return {"accuracy": format_table(heads, accuracy), "differences": compared}


COLOURS = (style.INK, style.POINT, style.BLUE, style.GREEN, style.VERMILLION, style.PURPLE)


class Reached(Protocol):
    """Accuracy of a federation after each round, from the initial weights on, with the time [s]."""

    @property
    def seconds(self) -> Sequence[float]:
        """The times, ascending."""
        ...

    @property
    def accuracy(self) -> Sequence[float]:
        """The accuracies."""
        ...


@style.styled
def draw_trajectories(found: Mapping[str, Mapping[str, Mapping[str, Reached]]], names: Sequence[str]) -> Figure:
    """Return the mean accuracy over seeds by time, a panel per setting; `found` is by setting, seed and name."""
    figure = style.canvas(7.2, 3.4)
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for panel, (setting, seeds) in zip(panels, found.items(), strict=True):
        until = min(reached.seconds[-1] for by_name in seeds.values() for reached in by_name.values())
        grid = np.linspace(0.0, until, 200)
        for name, colour in zip(names, COLOURS, strict=False):
            rows = [_hold(seeds[seed][name], grid) for seed in seeds]
            panel.plot(grid, np.mean(rows, axis=0), color=colour, label=name, linewidth=1.4)
        panel.set(xlabel="seconds on the network", title=setting)
    panels[0].set(ylabel=f"accuracy, mean of {len(next(iter(found.values())))} seeds")
    style.key(figure, panels[0].get_legend_handles_labels()[0], ncols=3)
    return figure


def _hold(reached: Reached, grid: np.ndarray) -> np.ndarray:
    """Return the accuracy at the times `grid` [s]: that after the last completed round."""
    last = np.searchsorted(reached.seconds, grid, side="right") - 1
    return np.asarray(reached.accuracy)[last]


def _run(out: Path, options: Options) -> Outcome[AsynchronyResult]:
    with options.show_progress(options.title) as report:
        results, pictures = compare_asynchrony(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(AsynchronyResult, _run, asynchrony_tables, seeds=5, takes=("seeds",))
