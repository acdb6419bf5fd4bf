"""Asynchronous rounds against synchronous ones, with stragglers: at equal megabytes, and at equal seconds.

Ten vehicles drive through all weathers, as in `flcav.experiments.attacks.drives`, linked by radio to one unit on the
pole with most traffic; three of them, drawn for each seed, train eight times as long. All ways to federate have the
same first weights, links and stragglers, and are scored at the same megabytes of uplink, those of `ROUNDS` rounds of
all, and at the same seconds, those in which FedAvg waits through these rounds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.experiments.asynchrony.schedules import Rival, Scheduled, schedule_buffers, schedule_rounds
from flcav.experiments.attacks.drives import Drives, Vehicle, draw_head, find_right, record_drives, spread_over_scenes
from flcav.experiments.differences import Differences, name_differences, tell_differences
from flcav.federation.rounds import Schedule, federate
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.runtimes.metered import Account
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.trainable import Trainable, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import BYTES_PER_MB, Ledger, LinkMegabytes
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import link_scene
from flcav.perception.weather.task import WEATHER
from flcav.report import style
from flcav.report.charts.federation.asynchrony import draw_trajectories
from flcav.runs.driving import Fleet
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import Stragglers, draw_stragglers
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.records import Record
from flcav.world.map.census import measure_traffic_density

ROUNDS, STEPS, LEARNING_RATE, TRAIN_S = 4, 5, 0.05, 1.0
SCENES = 4  # that follow one another, and repeat
STRAGGLERS = Stragglers(share=0.3, slower=8)
RARE = (6, 7)  # classes of weather that stragglers alone see, in the second setting
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
    """A federation of one seed: after each round the time, the uplink so far, and the accuracy on the test drives."""

    seconds: tuple[float, ...]
    up_mb: tuple[float, ...]
    accuracy: tuple[float, ...]
    updates: int  # that were combined within the equal seconds
    staleness: float  # of these, mean
    at: Mapping[str, float]  # accuracy at the equal megabytes and at the equal seconds
    took: Mapping[str, float]  # seconds at the equal megabytes, megabytes at the equal seconds


@dataclass(frozen=True)
class AsynchronyResult(Record):
    """Results by setting: trajectories by seed and rival, means over seeds, and differences to FedAvg that waits."""

    pictures: int  # of the test
    scenes: int
    stragglers: Mapping[str, tuple[str, ...]]  # by seed
    trajectories: Mapping[str, Mapping[str, Mapping[str, Trajectory]]]  # by setting, seed and rival
    accuracy: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by setting, measure and rival
    differences: Differences
    provenance: Provenance

    @property
    def claims(self) -> dict[str, MeanOverSeeds]:
        """Return all differences by name, whose verdicts are corrected together."""
        return name_differences(self.differences)

    def sentences(self) -> list[str]:
        """Return the differences in words."""
        return tell_differences(self.differences, "waiting")


def compare_asynchrony(
    out: Path, seeds: int, progress: Report = ignore_progress
) -> tuple[AsynchronyResult, dict[str, bytes]]:
    """Record the drives into `out`, and federate by each setting, seed and rival; return numbers and a picture."""
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
            own = found[setting].setdefault(str(seed), {})
            for name, rival in RIVALS.items():
                own[name], marks = follow(rival, scheduled[name], scheduled[WAITS], clients, drives, seed)
                for measure, each in marks.items():
                    right.setdefault((setting, measure, name), []).append(each)
                done += 1
                progress(done, total, f"seed {seed}, {setting}, {name}")
    results = summarise(drives, drawn, found, right)
    return results, {"asynchrony.png": style.png(draw_trajectories(results.trajectories, tuple(RIVALS)))}


def open_fleet(drives: Drives, seed: int) -> Fleet:
    """Return the vehicles, some of which are slow."""
    size = update_bytes(draw_head(seed))
    slow = draw_stragglers(STRAGGLERS, [*drives.vehicles], seed, REGION)
    clients = tuple(f"{REGION}/{name}" for name in drives.vehicles)
    return Fleet(REGION, clients, size, size, TRAIN_S, {f"{REGION}/{name}": speed for name, speed in slow.items()})


def link_drives(data: Dataset, seed: int) -> list[RadioLinks]:
    """Return the links of the first `SCENES` scenes to a unit on the pole with most traffic."""
    town = data.town()
    assert town is not None  # of a recording by this package
    names = list(dict.fromkeys(key.scene for key in data.keys))[:SCENES]
    traces = [trace for name in names if (trace := data.trace(name)) is not None]
    pole = int(town.poles.id[int(np.argmax(measure_traffic_density(town.poles.position, traces, 40.0)))])
    return [link_scene(data, Radio(), (pole,), name, seed).links for name in names]


def schedule_all(fleet: Fleet, links: list[RadioLinks]) -> dict[str, Scheduled]:
    """Return the rounds of every rival, for as long and as many bytes as FedAvg takes that waits."""
    waits = schedule_rounds(RIVALS[WAITS], fleet, links, ROUNDS)
    until_s, sent, found = waits.end_s[-1], sum(waits.up_bytes), {WAITS: waits}
    for name, rival in RIVALS.items():
        if isinstance(rival.strategy, FedBuff):
            found[name] = schedule_buffers(rival.strategy, fleet, links, until_s, sent)
        elif name != WAITS:
            rounds, own = ROUNDS, waits
            while own.end_s[-1] <= until_s or sum(own.up_bytes) <= sent:
                own = schedule_rounds(rival, fleet, links, rounds := rounds + ROUNDS)
            found[name] = own
    return found


def give_pictures(drives: Drives, fleet: Fleet, setting: str) -> dict[str, Trainable]:
    """Return the vehicles as clients; where they are unlike, those that are not slow lack the pictures of `RARE`."""
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
    rival: Rival, own: Scheduled, waits: Scheduled, clients: Mapping[str, Trainable], drives: Drives, seed: int
) -> tuple[Trajectory, dict[str, NDArray[np.float64]]]:
    """Return a federation by its schedule, and which pictures (N,) are right at the equal megabytes and seconds."""
    start, rounds = draw_head(seed), len(own.end_s)
    reached: list[Weights] = [start]
    book = Ledger(LinkMegabytes(1e6, 0.0))
    federate(
        clients,
        start,
        Schedule(rounds, STEPS, LEARNING_RATE, LEARNING_RATE, seed),
        Account(book, "edge", WEATHER.name, "wireless", own.outages),
        strategy=rival.strategy,
        buffers=own.buffers,
        on_round=lambda round_, weights, loss: reached.append(weights),
    )
    right = [find_right(weights, drives.test) for weights in reached]
    sent = np.cumsum([sum(e.bytes for e in book if (e.direction, e.round) == ("up", n + 1)) for n in range(rounds)])
    ends = {
        MEGABYTES: own.last_within(np.inf, sum(waits.up_bytes)),
        SECONDS: own.last_within(waits.end_s[-1], np.inf),
    }
    stale = [0] * (len(clients) * ends[SECONDS])
    if own.buffers is not None:
        counted = enumerate(own.buffers.rounds[: ends[SECONDS]])
        stale = [number - version for number, each in counted for version in each.versions.values()]
    elif own.outages:
        stale = stale[: len(stale) - sum(number <= ends[SECONDS] for number, _ in own.outages)]
    trajectory = Trajectory(
        seconds=(0.0, *(round(each, 3) for each in own.end_s)),
        up_mb=(0.0, *np.round(sent / BYTES_PER_MB, 4).tolist()),
        accuracy=tuple(round(float(each.mean()), 5) for each in right),
        updates=len(stale),
        staleness=float(np.mean(stale)) if stale else 0.0,
        at={measure: float(right[end].mean()) for measure, end in ends.items()},
        took={
            MEGABYTES: own.end_s[ends[MEGABYTES] - 1] if ends[MEGABYTES] else 0.0,
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
    """Return the means over seeds, which share the test's scenes."""

    def mean(values: list[NDArray[np.float64]], share: bool) -> MeanOverSeeds:
        means = [float(each.mean()) for each in values]
        return mean_over_seeds(means, share=share, shared=spread_over_scenes(drives.test, values))

    def difference(setting: str, measure: str, name: str) -> MeanOverSeeds:
        pairs = zip(right[setting, measure, name], right[setting, measure, WAITS], strict=True)
        return mean([one - other for one, other in pairs], share=False)

    return AsynchronyResult(
        pictures=len(drives.test.scenes),
        scenes=len(set(drives.test.scenes)),
        stragglers=drawn,
        trajectories=found,
        accuracy={s: {m: {n: mean(right[s, m, n], True) for n in RIVALS} for m in MEASURES} for s in SETTINGS},
        differences={
            s: {m: {n: difference(s, m, n) for n in RIVALS if n != WAITS} for m in MEASURES} for s in SETTINGS
        },
        provenance=provenance(),
    )
