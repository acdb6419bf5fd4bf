"""A vehicle's worth: whether the scores of `flcav.optimization.quality` rank vehicles by what their data really bring.

Pictures that vehicles recorded are dealt to eight of them by a Dirichlet draw of each class (`partition` of a run's
federation). A federation of all of them and one without each of them are trained, twice, from the same pretrained
network; what a vehicle brings is what the test loses without it. Seeds draw another partition, other initial weights
and other batches; they share the recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import open_split, record_split
from flcav.federation.loop import Schedule, federate
from flcav.federation.trainable import Weights
from flcav.machine.threads import use_threads
from flcav.optimization.curves.held_out import rank_correlation
from flcav.optimization.quality import data_quality, gradient_novelty, label_distribution_distance, visible_objects
from flcav.perception.client import TaskClient
from flcav.perception.study import read_recipe
from flcav.perception.task import build_network
from flcav.perception.weather.evaluate import predict_probabilities
from flcav.perception.weather.model import LeNetConfig
from flcav.perception.weather.samples import Sample
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import from_arrays, to_arrays
from flcav.report import style
from flcav.runs.engine import Notify, Step, Work, run_steps
from flcav.runs.extras.groups.members import find_gradient
from flcav.runs.extras.partition.samples import count_labels, deal_samples
from flcav.runs.extras.partition.settings import Partition
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import mean_over_seeds
from flcav.statistics.streams import derive_seed, stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, from_json, to_json

VEHICLES, TRAININGS = 8, 2
PARTITION = Partition(by="dirichlet", alpha=0.5)
POOL, DRIVES, TEST = "pool", "drives", "test"
RECORDINGS: Mapping[str, Mapping[str, Json]] = {  # fields beside those of recipes/weather.yaml
    POOL: {"town": "suburb", "seed": 4201, "scenes": 6, "cavs": 1},
    DRIVES: {"town": "ring", "seed": 4202, "scenes": 6, "cavs": 3},
    TEST: {"town": "ring", "seed": 4203, "scenes": 12, "cavs": 1, "split": "test"},
}
AMOUNT, LABELS, OBJECTS = "number of samples", "label distribution", "visible objects"
NOVELTY, QUALITY, TOTAL, AGAIN = "gradient novelty", "quality", "quality × samples", "worth in the other training"
SCORES = (AMOUNT, LABELS, OBJECTS, NOVELTY, QUALITY, TOTAL, AGAIN)


@dataclass(frozen=True)
class Size(Record):
    """Lengths of the trainings."""

    pretraining: int  # optimiser steps
    rounds: int
    steps: int  # of a vehicle in a round


FULL, TOY = Size(100, 10, 3), Size(2, 1, 1)
BATCH = 16  # of a vehicle


@dataclass(frozen=True)
class NetworkScore(Record):
    """A network on the test frames."""

    loss: float  # mean cross entropy
    accuracy: float


@dataclass(frozen=True)
class VehicleWorth(Record):
    """A vehicle's data, and the test of the federations without it, by training."""

    samples: int
    labels: Mapping[str, int]
    distance: float  # of its labels to the fleet's
    novelty: float  # of its gradient, at the pretrained network
    quality: float
    without: tuple[NetworkScore, ...]


@dataclass(frozen=True)
class FleetWorth(Record):
    """The vehicles of a seed, and the tests of the pretrained network and of the federations of all of them."""

    pretrained: NetworkScore
    everybody: tuple[NetworkScore, ...]  # by training
    vehicles: tuple[VehicleWorth, ...]

    def worth(self, training: int | None = None) -> list[float]:
        """Return the loss that each vehicle saves in a training; None: the mean of all trainings."""
        numbers = range(len(self.everybody)) if training is None else (training,)
        return [
            float(np.mean([own.without[n].loss - self.everybody[n].loss for n in numbers])) for own in self.vehicles
        ]

    def accuracy(self) -> list[float]:
        """Return the accuracy that each vehicle brings, mean over the trainings."""
        return [
            float(np.mean([self.everybody[n].accuracy - each.accuracy for n, each in enumerate(own.without)]))
            for own in self.vehicles
        ]

    def score(self, name: str) -> list[float]:
        """Return a score of each vehicle; of `AGAIN` what it saves in the second training."""
        if name == AGAIN:
            return self.worth(1)
        by_name = {
            AMOUNT: lambda own: own.samples,
            LABELS: lambda own: 1 - own.distance,
            OBJECTS: lambda own: sum(own.labels.values()) / own.samples,
            NOVELTY: lambda own: own.novelty,
            QUALITY: lambda own: own.quality,
            TOTAL: lambda own: own.quality * own.samples,
        }
        return [float(by_name[name](own)) for own in self.vehicles]

    def rank(self, name: str) -> float | None:
        """Return the rank correlation of a score with the loss that vehicles save; None where all score the same.

        That of `AGAIN` is between the two trainings, each of which has more noise than their mean.
        """
        score = self.score(name)
        return None if np.ptp(score) == 0 else rank_correlation(score, self.worth(0 if name == AGAIN else None))


@dataclass(frozen=True)
class WorthResult(Record):
    """Results by seed, and the rank correlations over seeds."""

    seeds: Mapping[str, FleetWorth]
    ranks: Mapping[str, Estimate | None]  # by score; None: it is the same for all vehicles
    size: Size
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the rank correlations in words."""
        return [f"{name}: rank correlation {_tell(self.ranks[name])}" for name in SCORES]


def _tell(mean: Estimate | None) -> str:
    return "undefined, the same for all vehicles" if mean is None else mean.describe(sign=True)


def measure_worth(
    out: Path, *, seeds: Sequence[int], quick: bool, jobs: int, notify: Notify, stale: str, engine: str
) -> WorthResult:
    """Run or finish the study in the folder `out`; `quick` is a smoke test of few frames and steps."""
    size = TOY if quick else FULL
    recordings = {name: {**read_recipe("weather"), **fields} for name, fields in RECORDINGS.items()}
    if quick:
        recordings = {name: {**fields, "scenes": 2} for name, fields in recordings.items()}
    steps = [Step(name, record_split, {"recipe": fields}) for name, fields in recordings.items()]
    steps += [Step(f"seed{seed}", leave_each_out, {"seed": seed, "size": size}, (*recordings,)) for seed in seeds]
    values = run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    return summarise({str(seed): from_json(FleetWorth, values[f"seed{seed}"], f"seed{seed}") for seed in seeds}, size)


def summarise(seeds: Mapping[str, FleetWorth], size: Size) -> WorthResult:
    """Return the results of all seeds."""
    ranks = {}
    for name in SCORES:
        found = [rank for own in seeds.values() if (rank := own.rank(name)) is not None]
        ranks[name] = average_ranks(found) if found else None
    return WorthResult(seeds, ranks, size, provenance())


def average_ranks(found: Sequence[float]) -> Estimate:
    """Return the mean of rank correlations, and its interval on Fisher's scale: the log-odds of (1 + r) / 2."""
    share = mean_over_seeds([(1 + rank) / 2 for rank in found], share=True)
    if share.low is None or share.high is None:
        return Estimate(2 * share.mean - 1, None, None)
    return Estimate(2 * share.mean - 1, 2 * share.low - 1, 2 * share.high - 1)


def leave_each_out(work: Work, seed: int, size: Size) -> Json:
    """Return the `FleetWorth` of a seed, as JSON."""
    use_threads(1)
    config = LeNetConfig()
    pool, drives, test = (WEATHER.samples(open_split(work.inputs[name]), config) for name in (POOL, DRIVES, TEST))
    names = [f"cav{number}" for number in range(VEHICLES)]
    whole = dict(zip(names, np.array_split(np.arange(len(drives)), VEHICLES), strict=True))
    mixed = {name: [drives[int(place)] for place in places] for name, places in whole.items()}
    counts = count_labels(mixed, config.classes)
    dealt, held = deal_samples(PARTITION, mixed, counts, None, stream(seed, "partition"))
    network, rate = build_network(WEATHER, config, seed), WEATHER.practice.learning_rate
    client = TaskClient(WEATHER, config, pool)
    start = client.train(to_arrays(network), steps=size.pretraining, learning_rate=rate, seed=seed).weights
    clients = {name: TaskClient(WEATHER, config, [*own], batch=BATCH) for name, own in dealt.items()}

    def train(taking_part: Sequence[str], training: int) -> NetworkScore:
        about = (size.rounds, size.steps, 0.5 * rate, 0.1 * rate, derive_seed(seed, "rounds", training))
        found = federate({name: clients[name] for name in taking_part}, start, Schedule(*about))
        return score(found.weights, test, config)

    everybody, without = list[NetworkScore](), {name: list[NetworkScore]() for name in names}
    for training in range(TRAININGS):
        everybody.append(train(names, training))
        for done, name in enumerate(names, start=1):
            without[name].append(train([each for each in names if each != name], training))
            work.report(training * VEHICLES + done, TRAININGS * VEHICLES, "trainings")
    table = np.array([[own.labels[label] for label in config.classes] for own in held.vehicles.values()])
    distance = label_distribution_distance(table)
    novelty = gradient_novelty([_flatten(find_gradient(_whole(own), start, seed)) for own in clients.values()])
    seen = visible_objects(table.sum(axis=1), [len(own) for own in dealt.values()])
    quality = data_quality(distance, seen, novelty)
    figures = zip(distance.tolist(), novelty.tolist(), quality.tolist(), strict=True)
    vehicles = tuple(
        VehicleWorth(own.samples, own.labels, far, new, good, tuple(without[name]))
        for (name, own), (far, new, good) in zip(held.vehicles.items(), figures, strict=True)
    )
    return to_json(FleetWorth(score(start, test, config), tuple(everybody), vehicles), FleetWorth)


def _whole(client: TaskClient) -> TaskClient:
    """Return the client with all its samples in a batch, whose gradient is then of all of them."""
    return TaskClient(client.task, client.config, client.samples, batch=len(client.samples))


def _flatten(gradient: Weights) -> np.ndarray:
    return np.concatenate([np.ravel(array) for array in gradient.values()])


def score(weights: Weights, test: Sequence[Sample], config: LeNetConfig) -> NetworkScore:
    """Return the test of a network with these weights."""
    network: Any = WEATHER.build(config)
    from_arrays(network, weights)
    found = predict_probabilities(network.eval(), [sample.picture for sample in test])
    labels = np.array([sample.label for sample in test])
    right = found[np.arange(len(test)), labels]
    return NetworkScore(float(-np.log(np.maximum(right, 1e-12)).mean()), float((found.argmax(axis=1) == labels).mean()))


@style.styled
def draw_worth(results: WorthResult) -> bytes:
    """Return the rank correlation of each score, with each seed's, and the worth of vehicles by quality × samples."""
    figure = style.canvas(8.4, 3.4)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.2, 1]})
    shown = {name: mean for name in SCORES if (mean := results.ranks[name]) is not None}
    for row, (name, mean) in enumerate(shown.items()):
        colour = style.MUTED if name == AGAIN else style.BLUE
        each = [own.rank(name) for own in results.seeds.values()]
        left.plot(each, [row] * len(each), "o", color=colour, alpha=0.35, markersize=4)
        left.plot([mean.low, mean.high], [row, row], color=colour, linewidth=1.5)
        left.plot(mean.mean, row, "o", color=colour, markersize=7)
    left.axvline(0, color=style.RULE, linewidth=0.8)
    left.set_yticks(range(len(shown)), [*shown])
    left.invert_yaxis()
    left.set(xlim=(-1.05, 1.05), xlabel="rank correlation with the loss that a vehicle saves")
    for own, colour in zip(results.seeds.values(), _colours(len(results.seeds)), strict=True):
        right.plot(own.score(TOTAL), own.worth(), "o", color=colour, markersize=4)
    right.axhline(0, color=style.RULE, linewidth=0.8)
    right.set(xlabel="quality × samples of a vehicle", ylabel="loss that it saves")
    return style.png(figure)


def _colours(count: int) -> list[str]:
    own = [style.BLUE, style.ORANGE, style.GREEN, style.VERMILLION, style.PURPLE, style.SKY]
    return [own[number % len(own)] for number in range(count)]


def worth_tables(results: WorthResult) -> dict[str, str]:
    """Return Markdown by name: ranks, networks, vehicles."""
    heads = ("score", "rank correlation with the loss saved", *(f"seed {seed}" for seed in results.seeds))
    ranks = [
        [
            name,
            _tell(results.ranks[name]),
            *("" if (rank := own.rank(name)) is None else f"{rank:+.2f}" for own in results.seeds.values()),
        ]
        for name in SCORES
    ]
    return {
        "ranks": format_table(heads, ranks),
        "networks": _networks(results),
        "vehicles": _vehicles(results),
    }


def _networks(results: WorthResult) -> str:
    rows = []
    for seed, own in results.seeds.items():
        accuracy, loss = (
            float(np.mean([getattr(each, name) for each in own.everybody])) for name in ("accuracy", "loss")
        )
        start = f"{own.pretrained.accuracy:.3f}, {own.pretrained.loss:.3f}"
        ends = f"{min(own.worth()):+.3f} to {max(own.worth()):+.3f}"
        rows.append([seed, start, f"{accuracy:.3f}, {loss:.3f}", ends])
    heads = ("seed", "pretrained: accuracy, loss", "all vehicles", "loss that a vehicle saves")
    return format_table(heads, rows)


def _vehicles(results: WorthResult) -> str:
    rows = []
    for seed, own in results.seeds.items():
        for number, (each, saved, gained) in enumerate(zip(own.vehicles, own.worth(), own.accuracy(), strict=True)):
            held = sum(count > 0 for count in each.labels.values())
            figures = (f"{each.distance:.2f}", f"{each.novelty:.3f}", f"{each.quality:.2f}")
            rows.append(
                [f"{seed}, cav{number}", str(each.samples), str(held), *figures, f"{saved:+.3f}", f"{gained:+.3f}"]
            )
    heads = (
        "seed, vehicle",
        "samples",
        "classes",
        "label distance",
        "novelty",
        "quality",
        "loss saved",
        "accuracy gained",
    )
    return format_table(heads, rows)


def _run(out: Path, options: Options) -> Outcome[WorthResult]:
    with options.show_steps(options.title) as notify:
        numbers = range(1, options.seeds + 1)
        results = measure_worth(out, seeds=numbers, quick=options.quick, **options.how(notify))
    return Outcome(results, {"worth.png": draw_worth(results)}, results.sentences())


EXPERIMENT = Experiment(WorthResult, _run, worth_tables, seeds=6)
