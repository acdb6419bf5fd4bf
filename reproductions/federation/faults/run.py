"""Byzantine clients: three of ten vehicles send wrong updates, under four strategies.

Attacks: the change of the weights with its sign flipped and multiplied by 4 (Li et al., "RSA", AAAI 2019); the change
multiplied by the number of clients, as in model replacement (Bagdasaryan et al., "How To Backdoor Federated Learning",
AISTATS 2020), or by more; and training on flipped labels, l for L - 1 - l of L classes (Fang et al., "Local Model
Poisoning Attacks", USENIX Security 2020).
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.experiments.comparison import tabulate_verdicts
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.exchange import ClientFailed
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.robust import Krum, Median, TrimmedMean
from flcav.federation.trainable import LocalUpdate, Trainable, Weights, learned_names
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.weather.task import WEATHER
from flcav.reproductions.federation.drives import (
    CLASSES,
    Drives,
    Vehicle,
    average_pictures,
    draw_head,
    find_right,
    record_drives,
)
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

BYZANTINE, ROUNDS, STEPS, LEARNING_RATE = 3, 10, 5, 0.05
HONEST, LABELS = "none", "label flip"
FACTORS = {"sign flip, -4": -4.0, "scaled, 10": 10.0, "scaled, 100": 100.0}  # on the change of the weights, by attack
LIES = (HONEST, *FACTORS, LABELS)
STRATEGIES: Mapping[str, Strategy] = {
    "FedAvg": FEDAVG,
    "median": Median(),
    "trimmed mean": TrimmedMean(BYZANTINE / 10),
    "Krum": Krum(byzantine=BYZANTINE),
}


@dataclass(frozen=True)
class Liar:
    """A client that sends its change of the weights multiplied by a factor."""

    client: Trainable
    factor: float

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return start + factor (trained - start) for the learned arrays; raises as the client does."""
        update = self.client.train(weights, steps=steps, learning_rate=learning_rate, seed=seed)
        sent = dict(update.weights)
        for name in learned_names(weights):
            start = weights[name]
            sent[name] = (start + self.factor * (update.weights[name] - start)).astype(start.dtype)
        return LocalUpdate(sent, update.samples, update.loss)


@dataclass(frozen=True)
class FaultsSeed:
    """Accuracy in one seed."""

    seed: int
    byzantine: tuple[str, ...]  # names of the Byzantine vehicles
    accuracy: Mapping[str, Mapping[str, float]]  # by attack and strategy


@dataclass(frozen=True)
class FaultsResult(Record):
    """Accuracy on held-out drives after the federation, by attack and strategy: by seed, and means over seeds."""

    pictures: int  # number in the test
    scenes: int
    seeds: tuple[FaultsSeed, ...]
    accuracy: Mapping[str, Mapping[str, MeanOverSeeds]]  # by attack and strategy
    gained: Mapping[str, Mapping[str, MeanOverSeeds]]  # over FedAvg, by attack and strategy
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the accuracies in words, a sentence per attack."""
        return [
            f"{lie}: " + ", ".join(f"{name} {mean.describe()}" for name, mean in row.items())
            for lie, row in self.accuracy.items()
        ]


def repeat_faults(out: Path, seeds: int, progress: Report = ignore_progress) -> tuple[FaultsResult, dict[str, bytes]]:
    """Record the drives to `out`, federate for each seed, attack and strategy, and return results without pictures."""
    drives = record_drives(out, progress)
    right: dict[tuple[str, str], list[NDArray[np.bool_]]] = {}
    liars = []
    total = seeds * len(LIES) * len(STRATEGIES)
    for seed in range(1, seeds + 1):
        start = draw_head(seed)
        liars.append(choose_liars(drives, seed))
        for lie in LIES:
            for name, strategy in STRATEGIES.items():
                weights = run_federation(drives, start, liars[-1], lie, strategy, seed)
                right.setdefault((lie, name), []).append(find_right(weights, drives.test))
                progress(sum(map(len, right.values())), total, f"seed {seed}, {lie}, {name}")
    return summarise(drives, liars, right), {}


def choose_liars(drives: Drives, seed: int) -> tuple[str, ...]:
    """Return the names of the Byzantine clients, redrawn for each seed."""
    names = [*drives.vehicles]
    return tuple(names[i] for i in sorted(stream(seed, "byzantine").permutation(len(names))[:BYZANTINE]))


def make_clients(drives: Drives, liars: tuple[str, ...], lie: str) -> dict[str, Trainable]:
    """Return the vehicles as clients, with the Byzantine ones under an attack."""
    clients: dict[str, Trainable] = {}
    for name, pictures in drives.vehicles.items():
        false = lie == LABELS and name in liars
        clients[name] = Vehicle(replace(pictures, labels=CLASSES - 1 - pictures.labels) if false else pictures)
    return clients | {name: Liar(clients[name], FACTORS[lie]) for name in liars if lie in FACTORS}


def run_federation(
    drives: Drives, start: Weights, liars: tuple[str, ...], lie: str, strategy: Strategy, seed: int
) -> Weights:
    """Return the weights after the federation; if training diverged, those of the last completed round."""
    account = Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", WEATHER.name, "wireless")
    reached: list[Weights] = [start]
    with contextlib.suppress(ClientFailed):
        federate(
            make_clients(drives, liars, lie),
            start,
            Schedule(ROUNDS, STEPS, LEARNING_RATE, LEARNING_RATE / 4, seed),
            account,
            strategy=strategy,
            rules=Rules(least_clients=10 - BYZANTINE),
            on_round=lambda round_, weights, loss: reached.append(weights),
        )
    return reached[-1]


def summarise(
    drives: Drives,
    liars: list[tuple[str, ...]],
    right: Mapping[tuple[str, str], list[NDArray[np.bool_]]],
) -> FaultsResult:
    """Return the means over seeds; these share the scenes of the test."""
    scenes = drives.test.scenes

    floats = {key: [correct.astype(float) for correct in values] for key, values in right.items()}
    rows = tuple(
        FaultsSeed(
            number + 1,
            liars[number],
            {lie: {name: float(right[lie, name][number].mean()) for name in STRATEGIES} for lie in LIES},
        )
        for number in range(len(liars))
    )
    robust = [name for name in STRATEGIES if name != "FedAvg"]
    gained = {
        lie: {
            name: average_pictures(
                drives.test, [one - other for one, other in zip(floats[lie, name], floats[lie, "FedAvg"])], share=False
            )
            for name in robust
        }
        for lie in LIES
    }
    return FaultsResult(
        pictures=len(scenes),
        scenes=len(set(scenes)),
        seeds=rows,
        accuracy={
            lie: {name: average_pictures(drives.test, floats[lie, name], share=True) for name in STRATEGIES}
            for lie in LIES
        },
        gained=gained,
        provenance=provenance(),
    )


def fault_tables(results: FaultsResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, gained."""
    rows = [[lie, *(results.accuracy[lie][name].describe() for name in STRATEGIES)] for lie in LIES]
    claims = {(lie, name): mean for lie in LIES for name in STRATEGIES if (mean := results.gained[lie].get(name))}
    return {
        "accuracy": format_table((f"attack by 3 of 10 clients, {len(results.seeds)} seeds", *STRATEGIES), rows),
        "gained": tabulate_verdicts(("attack", "strategy"), "accuracy - FedAvg's", claims, "an effect"),
    }


def _run(out: Path, options: Options) -> Outcome[FaultsResult]:
    with options.show_progress(options.title) as report:
        results, pictures = repeat_faults(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(FaultsResult, _run, fault_tables, seeds=5, takes=("seeds",))
