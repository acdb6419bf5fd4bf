"""Device selection with stragglers by the radio model, under one budget of uplink and one horizon in seconds.

Ten vehicles of `ring` learn the weather by the two fully connected layers of a LeNet that has been trained on the
pictures of a drive in `suburb`; three of them train eight times as long. Round n takes place in the n-th scene of their
drives.
Every way to choose who takes part begins with the same weights, links and stragglers, and ends with the last round that
is over within the horizon and whose uplink the budget pays: it is scored there.

Importance selection draws after training (Chen et al., TMLR 2022): on the clock all that are asked download, train and
report the norm of their update; once the last report has arrived, those that are drawn send theirs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.comparison import average_arms, mean_difference
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.links.in_process import update_bytes
from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.trainable import Trainable, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.clock.records import ClientWork
from flcav.network.clock.rounds import NetworkSettings, RoundRules, time_round
from flcav.network.ledger import BYTES_PER_MB, Direction, Ledger, LedgerEntry, LinkMegabytes
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import link_scene
from flcav.perception.client import TaskClient
from flcav.perception.task import build_network, find_configuration
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import from_arrays, to_arrays
from flcav.report import style
from flcav.reproductions.federation.asynchrony.run import draw_trajectories
from flcav.reproductions.federation.drives import HIDDEN, OUT, RECIPE, TEST, Pictures, Vehicle, find_right, see_pictures
from flcav.runs.driving import Fleet, drive_rounds
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import Stragglers, draw_stragglers
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.streams import derive_seed
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.map.census import measure_traffic_density

HORIZON_S, DEADLINE_S = 45.0, 5.0
BUDGET_UPDATES = 60  # of uplink, as a number of updates: six rounds of all vehicles
ROUNDS = 16  # more than any way has time and uplink for
STEPS, BATCH, LEARNING_RATE, TRAIN_S = 8, 16, 0.02, 1.0  # in a round; TRAIN_S [s] of a vehicle that is no straggler
FIRST_STEPS, FIRST_RATE = 720, 2e-3  # of pretraining
STRAGGLERS = Stragglers(share=0.3, slower=8)
RADIO = Radio(bandwidth_mhz=1)  # so that messages take as long as training
RANGE_M = 40.0  # [m] around a pole in which traffic counts
REGION, SCENES = "ring", 6
RARE = (6, 7)  # classes of weather that only stragglers see, in the second setting
ALIKE, UNLIKE = "vehicles alike", "stragglers alone see two weathers"
SETTINGS = (ALIKE, UNLIKE)
FIRST_SEED = 11  # those before it were looked at before the number of seeds was planned


EVERYBODY, PUNCTUAL = Selection(), Selection(rule="deadline", deadline_s=DEADLINE_S)


@dataclass(frozen=True)
class Way:
    """A way to choose the vehicles of a round, and whether the round ends at the deadline."""

    selection: Selection = EVERYBODY  # before the round
    ends: bool = False  # late updates are lost
    drawn: int | None = None  # so many in the mean send their update, by importance; None: all that were asked


START, WAITS, CUT, IN_TIME = "pretrained", "all, waits", "all, ends at the deadline", "in time, as predicted"
WAYS: Mapping[str, Way] = {
    WAITS: Way(),
    CUT: Way(ends=True),
    IN_TIME: Way(PUNCTUAL, ends=True),
    "importance, 7": Way(drawn=7),
    "importance, 4 of those in time": Way(PUNCTUAL, drawn=4),
    "chance, 7": Way(Selection(rule="uniform", clients=7)),
}


@dataclass(frozen=True)
class Course:
    """A federation of one seed: accuracy on the test drives after each round within horizon and budget."""

    seconds: tuple[float, ...]  # [s], from 0
    accuracy: tuple[float, ...]  # of the weights to begin with, then after each round
    up_mb: float  # uplink of these rounds [MB]
    updates: int  # combined in these rounds

    @property
    def reached(self) -> float:
        """The accuracy after the last round."""
        return self.accuracy[-1]

    @property
    def rounds(self) -> int:
        """The number of rounds."""
        return len(self.seconds) - 1


Seeds = Mapping[str, Mapping[str, Course]]  # by seed and way


@dataclass(frozen=True)
class StragglersResult(Record):
    """Courses by setting, means over seeds, and differences to waiting for all."""

    pictures: int  # of the test of a seed
    stragglers: Mapping[str, tuple[str, ...]]  # by seed
    courses: Mapping[str, Seeds]  # by setting
    accuracy: Mapping[str, Mapping[str, MeanOverSeeds]]  # by setting and way, `START` among them
    primary: MeanOverSeeds  # vehicles alike: deadline selection - waiting for all
    others: Mapping[str, MeanOverSeeds]  # other differences to waiting for all, corrected together
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the differences in words."""
        return [*describe_means({PRIMARY: self.primary}), *describe_means(self.others)]


PRIMARY = f"{ALIKE}: {IN_TIME} - {WAITS}"


def link_drives(data: Dataset, seed: int) -> list[RadioLinks]:
    """Return the links of all scenes to a unit on the pole with most traffic."""
    town = data.town()
    assert town is not None  # since the package recorded it
    names = list(dict.fromkeys(key.scene for key in data.keys))
    traces = [trace for name in names if (trace := data.trace(name)) is not None]
    density = measure_traffic_density(town.poles.position, traces, RANGE_M)
    pole = int(town.poles.id[int(np.argmax(density))])
    return [link_scene(data, RADIO, (pole,), name, seed).links for name in names]


def open_fleet(vehicles: Sequence[str], update: int, seed: int) -> Fleet:
    """Return the vehicles with their work in a round, updates of `update` bytes, and stragglers drawn by `seed`."""
    slow = draw_stragglers(STRAGGLERS, vehicles, seed, REGION)
    clients = tuple(f"{REGION}/{name}" for name in vehicles)
    return Fleet(REGION, clients, update, update, TRAIN_S, {f"{REGION}/{name}": speed for name, speed in slow.items()})


def give_pictures(pictures: Mapping[str, Pictures], fleet: Fleet, setting: str) -> dict[str, Trainable]:
    """Return the vehicles as clients; in the setting `UNLIKE`, only stragglers have the pictures of `RARE`.

    `pictures`: by name of the client.
    """
    clients: dict[str, Trainable] = {}
    for name in fleet.clients:
        seen = pictures[name]
        if setting == UNLIKE and name not in fleet.speeds:
            kept = np.flatnonzero(~np.isin(seen.labels, RARE))
            seen = Pictures(seen.features[kept], seen.labels[kept], tuple(seen.scenes[i] for i in kept))
        clients[name] = Vehicle(seen, BATCH)
    return clients


@dataclass(frozen=True)
class Begun:
    """The common start of all ways of a seed and setting: vehicles, links, data and initial weights."""

    fleet: Fleet
    links: Sequence[RadioLinks]  # by scene
    clients: Mapping[str, Trainable]
    start: Weights
    test: Pictures
    seed: int


@dataclass(frozen=True)
class Followed:
    """The rounds of a federation, more than are within horizon and budget."""

    weights: Sequence[Weights]  # those to begin with, then after each round
    seconds: Sequence[float]  # duration of each round [s]
    up_bytes: Sequence[int]  # of each round
    updates: Sequence[int]  # combined in each round


def follow(way: Way, begun: Begun) -> Followed:
    """Return a federation with its times on the network, up to a round that ends beyond the horizon, or `ROUNDS`."""
    schedule = Schedule(ROUNDS, STEPS, LEARNING_RATE, LEARNING_RATE, begun.seed)
    settings = NetworkSettings(radio=RADIO, rounds=RoundRules(deadline_s=DEADLINE_S if way.ends else None))
    seeds = [schedule.work(number).seed for number in range(1, ROUNDS + 1)]
    driven = drive_rounds(begun.fleet, begun.links, settings, Rules(selection=way.selection), seeds, 0)
    rules, outages = driven.rules, driven.outages
    rounds = min(ROUNDS, 1 + int(np.sum(np.cumsum(driven.seconds) <= HORIZON_S)))
    if way.drawn is not None:
        rules = Rules(selection=Selection(rule="importance", clients=way.drawn))
        outages = {key: each for key, each in outages.items() if each.sent_bytes is None}  # those not asked
        rounds = bound_drawn(begun.fleet, outages)  # times follow from who is drawn
    numbers = range(1, rounds + 1)
    book, state, weights = Ledger(LinkMegabytes(1e6, 0.0)), FederationState(), [begun.start]
    federate(
        begun.clients,
        begun.start,
        replace(schedule, rounds=rounds),
        Account(book, "edge", WEATHER.name, "wireless", outages),
        rules=rules,
        state=state,
        on_round=lambda _, reached, __: weights.append(reached),
    )
    messages = [[entry for entry in book if entry.round == number] for number in numbers]
    seconds = driven.seconds[:rounds]
    if way.drawn is not None:
        asked = [
            [entry for entry in entries if (number, entry.client) not in outages]
            for number, entries in zip(numbers, messages, strict=True)
        ]
        seconds = [
            time_drawn(begun.fleet, begun.links[(number - 1) % len(begun.links)], number, entries)
            for number, entries in zip(numbers, asked, strict=True)
        ]
    return Followed(
        weights,
        seconds,
        [sum(entry.bytes for entry in entries if entry.direction == "up") for entries in messages],
        [len(record.clients) for record in state.records],
    )


def bound_drawn(fleet: Fleet, outages: Mapping[tuple[int, str], Outage]) -> int:
    """Return a number of rounds of importance selection that the horizon does not have time for, at most `ROUNDS`.

    A round lasts at least as long as the training of the slowest vehicle that is asked.
    """
    least_s = min(
        max((fleet.work(name).compute_s for name in fleet.clients if (number, name) not in outages), default=TRAIN_S)
        for number in range(1, ROUNDS + 1)
    )
    return min(ROUNDS, 1 + int(HORIZON_S / least_s))


def time_drawn(fleet: Fleet, links: RadioLinks, number: int, entries: Sequence[LedgerEntry]) -> float:
    """Return the duration [s] of a round of importance selection with these messages.

    In its first part clients download, train and report; in the second, which begins with the last report, those that
    are drawn are asked for their update and send it.
    """
    begins = now = float(links.time_s[0])
    for part in (0, 1):
        works = list[ClientWork]()
        for name in fleet.clients:
            down, up = (_find_message(entries, name, direction, part) for direction in ("down", "up"))
            if down is not None and up is not None:
                compute_s = fleet.work(name).compute_s if part == 0 else 0.0
                works.append(ClientWork(fleet.work(name).client, down, compute_s, up))
        if works:
            now = max(timing.end_s for timing in time_round(links, works, number, now, RoundRules()))
    return now - begins


def _find_message(entries: Sequence[LedgerEntry], client: str, direction: Direction, part: int) -> int | None:
    """Return the bytes of a client's message of a part of the round; None where there is none."""
    sent = [entry.bytes for entry in entries if (entry.client, entry.direction) == (client, direction)]
    return sent[part] if part < len(sent) else None


def end_within(seconds: Sequence[float], up_bytes: Sequence[int], horizon_s: float, budget_bytes: float) -> int:
    """Return the number of rounds, which last `seconds` [s], that end within a horizon and whose uplink is paid."""
    within = (np.cumsum(seconds) <= horizon_s) & (np.cumsum(up_bytes) <= budget_bytes)
    assert not within.all(), "more rounds fit than were run"
    return int(np.argmin(within))


def run_way(way: Way, begun: Begun) -> Course:
    """Return a federation up to the end of horizon or budget."""
    found = follow(way, begun)
    rounds = end_within(found.seconds, found.up_bytes, HORIZON_S, BUDGET_UPDATES * begun.fleet.upload_bytes)
    return Course(
        seconds=(0.0, *np.round(np.cumsum(found.seconds[:rounds]), 3).tolist()),
        accuracy=tuple(round(float(find_right(each, begun.test).mean()), 5) for each in found.weights[: rounds + 1]),
        up_mb=round(sum(found.up_bytes[:rounds]) / BYTES_PER_MB, 4),
        updates=sum(found.updates[:rounds]),
    )


def record_drives(folder: Path, seed: int, progress: Report = ignore_progress) -> dict[str, Dataset]:
    """Record the drives of a seed, or resume an interrupted recording, and return them by name."""
    start = {**RECIPE, "town": "suburb", "scenes": 1}
    for name, recipe in (("start", start), ("train", {**RECIPE, "scenes": SCENES}), ("test", TEST)):
        drawn = {**recipe, "seed": derive_seed(seed, name)}
        record(EmbeddedSource(parse_config(Recipe, drawn, name)), folder / name, progress=progress)
    return {name: Dataset.open(folder / name) for name in ("start", "train", "test")}


def begin_seed(drives: Mapping[str, Dataset], seed: int) -> dict[str, Begun]:
    """Return what all ways of a seed begin with, by setting: the network is pretrained on the drive `start`."""
    config = find_configuration(WEATHER, "tiny")
    network = build_network(WEATHER, config, derive_seed(seed, "network"))
    own = TaskClient(WEATHER, config, WEATHER.samples(drives["start"], config), batch=BATCH)
    trained = own.train(
        to_arrays(network), steps=FIRST_STEPS, learning_rate=FIRST_RATE, seed=derive_seed(seed, "pretraining")
    ).weights
    from_arrays(network, trained)
    start = {name: array for name, array in trained.items() if name.startswith((f"{HIDDEN}.", f"{OUT}."))}
    data = drives["train"]
    vehicles = sorted({key.agent for key in data.keys})
    fleet, links = open_fleet(vehicles, update_bytes(start), seed), link_drives(data, seed)
    frames = {name: [i for i, key in enumerate(data.keys) if key.agent == name] for name in vehicles}
    pictures = {f"{REGION}/{name}": see_pictures(network, data, frames[name]) for name in vehicles}
    test = see_pictures(network, drives["test"], None)
    return {
        setting: Begun(fleet, links, give_pictures(pictures, fleet, setting), start, test, seed) for setting in SETTINGS
    }


def compare_ways(out: Path, seeds: int, progress: Report = ignore_progress) -> StragglersResult:
    """Record the drives of each seed to `out`, federate in each way, and return the results."""
    courses: dict[str, dict[str, dict[str, Course]]] = {setting: {} for setting in SETTINGS}
    drawn: dict[str, tuple[str, ...]] = {}
    pictures = 0
    for done, seed in enumerate(range(FIRST_SEED, FIRST_SEED + seeds), start=1):
        begun = begin_seed(record_drives(out / f"seed{seed}", seed, progress), seed)
        drawn[str(seed)] = tuple(name.removeprefix(f"{REGION}/") for name in begun[ALIKE].fleet.speeds)
        pictures = len(begun[ALIKE].test.labels)
        for setting, own in begun.items():
            courses[setting][str(seed)] = {name: run_way(way, own) for name, way in WAYS.items()}
        progress(done, seeds, f"seed {seed}")
    return summarise(pictures, drawn, courses)


def summarise(pictures: int, drawn: Mapping[str, tuple[str, ...]], courses: Mapping[str, Seeds]) -> StragglersResult:
    """Return means over seeds, which have drives of their own."""
    differences = {
        f"{setting}: {name} - {WAITS}": mean_difference(seeds, name, WAITS, lambda course: course.reached)
        for setting, seeds in courses.items()
        for name in WAYS
        if name != WAITS
    }
    accuracy = {
        setting: {
            START: average_arms(seeds, [WAITS], lambda course: course.accuracy[0])[WAITS],
            **average_arms(seeds, WAYS, lambda course: course.reached),
        }
        for setting, seeds in courses.items()
    }
    primary = differences.pop(PRIMARY)
    return StragglersResult(pictures, drawn, courses, accuracy, primary, differences, provenance())


def tabulate_stragglers(results: StragglersResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, primary, others."""
    rows: list[list[str]] = []
    for setting in SETTINGS:
        of_setting = results.accuracy[setting]
        rows.append([setting, START, of_setting[START].describe(), "", "", "", ""])
        for name in WAYS:
            own = [seed[name] for seed in results.courses[setting].values()]
            numbers = (
                f"{np.mean([course.rounds for course in own]):.1f}",
                f"{np.mean([course.seconds[-1] / course.rounds for course in own]):.1f}",
                f"{np.mean([course.updates for course in own]):.0f}",
                f"{np.mean([course.up_mb for course in own]):.2f}",
            )
            rows.append([setting, name, of_setting[name].describe(), *numbers])
    seeds = len(results.stragglers)
    heads = (f"vehicles, {seeds} seeds", "who takes part", "accuracy", "rounds", "s a round", "updates", "MB up")
    return {
        "accuracy": format_table(heads, rows),
        "primary": tabulate_means("primary claim: difference in accuracy", {PRIMARY: results.primary}),
        "others": tabulate_means("difference in accuracy", results.others),
    }


def draw_courses(results: StragglersResult) -> bytes:
    """Return the mean accuracy by time as a PNG, a panel for each setting; what is reached holds up to the horizon."""

    def hold(course: Course) -> Course:
        return replace(course, seconds=(*course.seconds, HORIZON_S), accuracy=(*course.accuracy, course.reached))

    held = {
        setting: {seed: {name: hold(course) for name, course in ways.items()} for seed, ways in seeds.items()}
        for setting, seeds in results.courses.items()
    }
    return style.png(draw_trajectories(held, tuple(WAYS)))


def _run(out: Path, options: Options) -> Outcome[StragglersResult]:
    with options.show_progress(options.title) as report:
        results = compare_ways(out, options.seeds, report)
    return Outcome(results, {"stragglers.png": draw_courses(results)}, results.sentences())


EXPERIMENT = Experiment(StragglersResult, _run, tabulate_stragglers, seeds=40, takes=("seeds",))
