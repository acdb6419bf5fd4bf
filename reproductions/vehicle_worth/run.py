"""A vehicle's worth: whether the scores of `flcav.optimization.quality` rank vehicles by the worth of their data.

Recorded pictures are dealt to eight vehicles by a Dirichlet draw of each class (`partition` of a run's federation). A
federation of all of them, and one without each of them, are trained twice from the same pretrained network. The worth
of a vehicle is the increase of the test loss without it. Each seed draws its own partition, initial weights and
batches; seeds share the recordings.
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
RECORDINGS: Mapping[str, Mapping[str, Json]] = {  # fields that replace those of recipes/weather.yaml
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
    steps: int  # per vehicle and round


FULL, TOY = Size(100, 10, 3), Size(2, 1, 1)
BATCH = 16  # samples per step of a vehicle


@dataclass(frozen=True)
class NetworkScore(Record):
    """The scores of a network on the test frames."""

    loss: float  # mean cross entropy
    accuracy: float


@dataclass(frozen=True)
class VehicleWorth(Record):
    """The data of a vehicle, and the scores of the federations without it."""

    samples: int
    labels: Mapping[str, int]  # samples by class
    distance: float  # of its label distribution from the fleet's
    novelty: float  # of its gradient, at the pretrained network
    quality: float
    without: tuple[NetworkScore, ...]  # by training


@dataclass(frozen=True)
class FleetWorth(Record):
    """The vehicles of a seed, and the scores of the pretrained network and of the federations of all vehicles."""

    pretrained: NetworkScore
    everybody: tuple[NetworkScore, ...]  # by training
    vehicles: tuple[VehicleWorth, ...]

    def worth(self, training: int | None = None) -> list[float]:
        """Return the loss that each vehicle saves in a training, or in the mean of all trainings (None)."""
        numbers = range(len(self.everybody)) if training is None else (training,)
        return [
            float(np.mean([vehicle.without[n].loss - self.everybody[n].loss for n in numbers]))
            for vehicle in self.vehicles
        ]

    def accuracy(self) -> list[float]:
        """Return the accuracy that each vehicle adds, as the mean over trainings."""
        return [
            float(np.mean([self.everybody[n].accuracy - score.accuracy for n, score in enumerate(vehicle.without)]))
            for vehicle in self.vehicles
        ]

    def score(self, name: str) -> list[float]:
        """Return one of `SCORES` for each vehicle; `AGAIN` is the loss that it saves in the second training."""
        if name == AGAIN:
            return self.worth(1)
        by_name = {
            AMOUNT: lambda vehicle: vehicle.samples,
            LABELS: lambda vehicle: 1 - vehicle.distance,
            OBJECTS: lambda vehicle: sum(vehicle.labels.values()) / vehicle.samples,
            NOVELTY: lambda vehicle: vehicle.novelty,
            QUALITY: lambda vehicle: vehicle.quality,
            TOTAL: lambda vehicle: vehicle.quality * vehicle.samples,
        }
        return [float(by_name[name](vehicle)) for vehicle in self.vehicles]

    def rank(self, name: str) -> float | None:
        """Return the rank correlation of a score with the loss that vehicles save; None if all have the same score.

        That of `AGAIN` is between the two trainings, each of which is noisier than their mean.
        """
        score = self.score(name)
        return None if np.ptp(score) == 0 else rank_correlation(score, self.worth(0 if name == AGAIN else None))


@dataclass(frozen=True)
class WorthResult(Record):
    """Results by seed, and the rank correlations over seeds."""

    seeds: Mapping[str, FleetWorth]
    ranks: Mapping[str, Estimate | None]  # by score; None where all vehicles have the same score
    size: Size
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return a sentence with the rank correlation of each score."""
        return [f"{name}: rank correlation {_describe(self.ranks[name])}" for name in SCORES]


def _describe(mean: Estimate | None) -> str:
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
        ranks_of_seeds = [rank for fleet in seeds.values() if (rank := fleet.rank(name)) is not None]
        ranks[name] = average_ranks(ranks_of_seeds) if ranks_of_seeds else None
    return WorthResult(seeds, ranks, size, provenance())


def average_ranks(found: Sequence[float]) -> Estimate:
    """Return the mean of rank correlations r, with an interval on Fisher's scale, the log-odds of (1 + r) / 2."""
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
    dealt_evenly = dict(zip(names, np.array_split(np.arange(len(drives)), VEHICLES), strict=True))
    samples_of = {name: [drives[int(place)] for place in places] for name, places in dealt_evenly.items()}
    counts = count_labels(samples_of, config.classes)
    dealt, partition = deal_samples(PARTITION, samples_of, counts, None, stream(seed, "partition"))
    network, rate = build_network(WEATHER, config, seed), WEATHER.practice.learning_rate
    client = TaskClient(WEATHER, config, pool)
    start = client.train(to_arrays(network), steps=size.pretraining, learning_rate=rate, seed=seed).weights
    clients = {name: TaskClient(WEATHER, config, [*samples], batch=BATCH) for name, samples in dealt.items()}

    def train(taking_part: Sequence[str], training: int) -> NetworkScore:
        lengths = (size.rounds, size.steps, 0.5 * rate, 0.1 * rate, derive_seed(seed, "rounds", training))
        found = federate({name: clients[name] for name in taking_part}, start, Schedule(*lengths))
        return score(found.weights, test, config)

    everybody, without = list[NetworkScore](), {name: list[NetworkScore]() for name in names}
    for training in range(TRAININGS):
        everybody.append(train(names, training))
        for done, name in enumerate(names, start=1):
            without[name].append(train([other for other in names if other != name], training))
            work.report(training * VEHICLES + done, TRAININGS * VEHICLES, "trainings")
    table = np.array([[row.labels[label] for label in config.classes] for row in partition.vehicles.values()])
    distance = label_distribution_distance(table)
    novelty = gradient_novelty([_flatten(find_gradient(_whole(client), start, seed)) for client in clients.values()])
    seen = visible_objects(table.sum(axis=1), [len(samples) for samples in dealt.values()])
    quality = data_quality(distance, seen, novelty)
    figures = zip(distance.tolist(), novelty.tolist(), quality.tolist(), strict=True)
    vehicles = tuple(
        VehicleWorth(row.samples, row.labels, *scores, tuple(without[name]))
        for (name, row), scores in zip(partition.vehicles.items(), figures, strict=True)
    )
    return to_json(FleetWorth(score(start, test, config), tuple(everybody), vehicles), FleetWorth)


def _whole(client: TaskClient) -> TaskClient:
    """Return the client with all its samples in one batch, whose gradient then is that of all samples."""
    return TaskClient(client.task, client.config, client.samples, batch=len(client.samples))


def _flatten(gradient: Weights) -> np.ndarray:
    return np.concatenate([np.ravel(array) for array in gradient.values()])


def score(weights: Weights, test: Sequence[Sample], config: LeNetConfig) -> NetworkScore:
    """Return the loss and the accuracy of a network with these weights on test samples."""
    network: Any = WEATHER.build(config)
    from_arrays(network, weights)
    probabilities = predict_probabilities(network.eval(), [sample.picture for sample in test])
    labels = np.array([sample.label for sample in test])
    right = probabilities[np.arange(len(test)), labels]
    return NetworkScore(
        float(-np.log(np.maximum(right, 1e-12)).mean()), float((probabilities.argmax(axis=1) == labels).mean())
    )


@style.styled
def draw_worth(results: WorthResult) -> bytes:
    """Return a PNG: the rank correlation of each score, over seeds and in each, and worth against quality × samples."""
    figure = style.canvas(8.4, 3.4)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.2, 1]})
    shown = {name: mean for name in SCORES if (mean := results.ranks[name]) is not None}
    for row, (name, mean) in enumerate(shown.items()):
        colour = style.MUTED if name == AGAIN else style.BLUE
        of_seeds = [fleet.rank(name) for fleet in results.seeds.values()]
        left.plot(of_seeds, [row] * len(of_seeds), "o", color=colour, alpha=0.35, markersize=4)
        left.plot([mean.low, mean.high], [row, row], color=colour, linewidth=1.5)
        left.plot(mean.mean, row, "o", color=colour, markersize=7)
    left.axvline(0, color=style.RULE, linewidth=0.8)
    left.set_yticks(range(len(shown)), [*shown])
    left.invert_yaxis()
    label = "rank correlation with the loss that a vehicle saves:\ncircles: seeds, dots: means, 95 % interval"
    left.set(xlim=(-1.05, 1.05), xlabel=label)
    for fleet, colour in zip(results.seeds.values(), _colours(len(results.seeds)), strict=True):
        right.plot(fleet.score(TOTAL), fleet.worth(), "o", color=colour, markersize=4)
    right.axhline(0, color=style.RULE, linewidth=0.8)
    right.set(xlabel="quality × samples of a vehicle", ylabel="loss that it saves")
    return style.png(figure)


def _colours(count: int) -> list[str]:
    colours = [style.BLUE, style.ORANGE, style.GREEN, style.VERMILLION, style.PURPLE, style.SKY]
    return [colours[number % len(colours)] for number in range(count)]


def worth_tables(results: WorthResult) -> dict[str, str]:
    """Return Markdown by name: ranks, networks, vehicles."""
    heads = ("score", "rank correlation with the loss saved", *(f"seed {seed}" for seed in results.seeds))
    ranks = [
        [
            name,
            _describe(results.ranks[name]),
            *("" if (rank := fleet.rank(name)) is None else f"{rank:+.2f}" for fleet in results.seeds.values()),
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
    for seed, fleet in results.seeds.items():
        accuracy, loss = (
            float(np.mean([getattr(federation, name) for federation in fleet.everybody]))
            for name in ("accuracy", "loss")
        )
        start = f"{fleet.pretrained.accuracy:.3f}, {fleet.pretrained.loss:.3f}"
        ends = f"{min(fleet.worth()):+.3f} to {max(fleet.worth()):+.3f}"
        rows.append([seed, start, f"{accuracy:.3f}, {loss:.3f}", ends])
    heads = ("seed", "pretrained: accuracy, loss", "all vehicles", "loss that a vehicle saves")
    return format_table(heads, rows)


def _vehicles(results: WorthResult) -> str:
    rows = []
    for seed, fleet in results.seeds.items():
        for number, (vehicle, saved, gained) in enumerate(
            zip(fleet.vehicles, fleet.worth(), fleet.accuracy(), strict=True)
        ):
            held = sum(count > 0 for count in vehicle.labels.values())
            figures = (f"{vehicle.distance:.2f}", f"{vehicle.novelty:.3f}", f"{vehicle.quality:.2f}")
            rows.append(
                [f"{seed}, cav{number}", str(vehicle.samples), str(held), *figures, f"{saved:+.3f}", f"{gained:+.3f}"]
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
