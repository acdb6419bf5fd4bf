"""Robust aggregation under attack, with and without nearest-neighbour mixing, by share of attackers and heterogeneity.

Attackers collude, and know all honest updates of a round. *A little is enough*: all send the honest mean minus 1.5
standard deviations of each coordinate (Baruch et al., NeurIPS 2019). *Inner product*: minus the honest mean change (Xie
et al., UAI 2020). *Sign flip*: the attacker's change times -4 (Li et al., AAAI 2019). *Label flip*: trained on l for
L - 1 - l of L classes (Fang et al., USENIX Security 2020). *Noise*: the start with Gaussian noise, ten times the norm
of the honest mean change.

Clients draw their classes from a Dirichlet distribution (Hsu et al., 2019): the smaller its concentration, the more
heterogeneous their data. The clients of a round are trained together, by one matrix product per step and without
messages; the updates are combined by the strategies of the package.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.robust import Krum, Median, TrimmedMean
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.report import style
from flcav.reproductions.federation.drives import CLASSES, HIDDEN, OUT, Labels, Pictures, Vector, find_right
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

CLIENTS, SAMPLES, TESTED, INPUTS, UNITS = 20, 64, 512, 16, 24
ROUNDS, STEPS, BATCH, RATE = 25, 5, 16, 0.1
SPREAD = 1.2  # standard deviation of a class about its centre; coordinates of centres have a standard deviation of 1
ATTACKERS = (2, 4, 6, 8)  # of `CLIENTS`
UNLIKENESS = {"alike": 1e6, "unlike": 1.0, "very unlike": 0.1}  # concentration of the Dirichlet distribution
NONE, LITTLE, INNER, SIGN, LABEL, NOISE = "none", "a little", "inner product", "sign flip", "label flip", "noise"
ATTACKS = (LITTLE, INNER, SIGN, LABEL, NOISE)
DEVIATIONS, LENGTH = 1.5, 10.0
WITHSTOOD = 0.05  # greatest loss of accuracy compared with the plain mean without an attack


def make_rules(attackers: int) -> dict[str, Strategy]:
    """Return the strategies by name; robust ones know the number of attackers."""
    share = attackers / CLIENTS
    plain: dict[str, Strategy] = {
        "median": Median(),
        "trimmed mean": TrimmedMean(share),
        "Krum": Krum(attackers),
        "multi-Krum": Krum(attackers, kept=CLIENTS - attackers),
    }
    mixed: dict[str, Strategy] = {
        "mixing, median": Median(attackers),
        "mixing, trimmed mean": TrimmedMean(share, attackers),
        "mixing, Krum": Krum(attackers, 1, attackers),
        "mixing, multi-Krum": Krum(attackers, CLIENTS - attackers, attackers),
    }
    return {"mean": FEDAVG, **plain, **mixed}


RULES = tuple(make_rules(1))

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Fleet:
    """Samples of the clients of one seed; the first clients are the attackers."""

    features: Vector  # (clients, samples, inputs)
    labels: Labels  # (clients, samples)
    test: Pictures


def draw_fleet(unlikeness: str, seed: int) -> Fleet:
    """Return samples of Gaussian classes about random centres; clients draw different shares of the classes."""
    rng = stream(seed, "clusters")
    centres = rng.normal(size=(CLASSES, INPUTS))

    def see(labels: Labels) -> Vector:
        return (centres[labels] + SPREAD * rng.normal(size=(*labels.shape, INPUTS))).astype(np.float32)

    shares = rng.dirichlet(np.full(CLASSES, UNLIKENESS[unlikeness]), CLIENTS)
    labels = np.stack([rng.choice(CLASSES, SAMPLES, p=share) for share in shares])
    tested = np.arange(TESTED) % CLASSES
    return Fleet(see(labels), labels, Pictures(see(tested), tested, ()))


def draw_network(seed: int) -> dict[str, Vector]:
    """Return the initial weights of a network with one hidden layer, by He et al., 2015."""
    rng = stream(seed, "network")
    first = rng.normal(size=(UNITS, INPUTS))
    second = rng.normal(size=(CLASSES, UNITS))
    arrays = {
        f"{HIDDEN}.weight": first * np.sqrt(2 / INPUTS),
        f"{HIDDEN}.bias": np.zeros(UNITS),
        f"{OUT}.weight": second * np.sqrt(2 / UNITS),
        f"{OUT}.bias": np.zeros(CLASSES),
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def train_clients(
    start: Weights, features: Vector, labels: Labels, rate: float, rng: np.random.Generator
) -> dict[str, Vector]:
    """Return the clients' weights (clients, ...) after gradient steps on the cross entropy of different batches."""
    clients = np.arange(len(labels))[:, None]
    reached = {name: np.repeat(array[None], len(labels), axis=0).astype(np.float32) for name, array in start.items()}
    for _ in range(STEPS):
        places = rng.integers(labels.shape[1], size=(len(labels), BATCH))
        seen, targets = features[clients, places], np.eye(CLASSES, dtype=np.float32)[labels[clients, places]]
        hidden = np.maximum(
            seen @ reached[f"{HIDDEN}.weight"].transpose(0, 2, 1) + reached[f"{HIDDEN}.bias"][:, None], 0
        )
        logits = hidden @ reached[f"{OUT}.weight"].transpose(0, 2, 1) + reached[f"{OUT}.bias"][:, None]
        powers = np.exp(logits - logits.max(axis=2, keepdims=True))
        at_output = (powers / powers.sum(axis=2, keepdims=True) - targets) / BATCH
        at_hidden = (at_output @ reached[f"{OUT}.weight"]) * (hidden > 0)
        slopes = {
            f"{HIDDEN}.weight": at_hidden.transpose(0, 2, 1) @ seen,
            f"{HIDDEN}.bias": at_hidden.sum(axis=1),
            f"{OUT}.weight": at_output.transpose(0, 2, 1) @ hidden,
            f"{OUT}.bias": at_output.sum(axis=1),
        }
        reached = {name: array - np.float32(rate) * slopes[name] for name, array in reached.items()}
    return reached


def lie(attack: str, attackers: int, start: Floats, sent: Floats, rng: np.random.Generator) -> Floats:
    """Return the updates (clients, coordinates) under an attack by the first clients, from the trained ones, `sent`.

    `start` (coordinates,) are the weights at the start of the round. Under `LABEL` attackers send what they trained.
    """
    honest = sent[attackers:].astype(np.float64)
    change = honest.mean(axis=0) - start
    updates = sent.copy()
    if attack == LITTLE:
        updates[:attackers] = honest.mean(axis=0) - DEVIATIONS * honest.std(axis=0)
    elif attack == INNER:
        updates[:attackers] = start - change
    elif attack == SIGN:
        updates[:attackers] = start - 4 * (sent[:attackers] - start)
    elif attack == NOISE:
        size = LENGTH * np.linalg.norm(change) / np.sqrt(change.size)
        updates[:attackers] = start + size * rng.normal(size=(attackers, change.size))
    return updates


def run_rounds(fleet: Fleet, strategy: Strategy, attack: str, attackers: int, seed: int) -> dict[str, Vector]:
    """Return the weights after the rounds under a strategy, with the first `attackers` clients attacking."""
    labels = fleet.labels.copy()
    if attack == LABEL:
        labels[:attackers] = CLASSES - 1 - labels[:attackers]
    reached, noise = draw_network(seed), stream(seed, "noise")
    ends = np.cumsum([array.size for array in reached.values()])[:-1]
    for number in range(ROUNDS):
        rate, rng = RATE / 4 ** (number / max(ROUNDS - 1, 1)), stream(seed, "batches", number)
        trained = train_clients(reached, fleet.features, labels, rate, rng)
        flat = np.concatenate([array.reshape(CLIENTS, -1) for array in trained.values()], axis=1)
        start = np.concatenate([array.ravel() for array in reached.values()])
        if attack != NONE:
            flat = lie(attack, attackers, start, flat, noise)
        parts = np.split(flat, ends, axis=1)
        sent = [
            {name: part[i].reshape(array.shape) for part, (name, array) in zip(parts, reached.items(), strict=True)}
            for i in range(CLIENTS)
        ]
        combined = strategy.combine(reached, [LocalUpdate(weights, SAMPLES, 0.0) for weights in sent])
        reached = {name: np.asarray(array, np.float32) for name, array in combined.items()}
    return reached


@dataclass(frozen=True)
class Withstood(Record):
    """Accuracy under one attack by rule, as means over seeds."""

    unlikeness: str
    attackers: int  # number of `CLIENTS`
    attack: str
    accuracy: Mapping[str, MeanOverSeeds]
    lost: Mapping[str, MeanOverSeeds]  # loss of accuracy compared with the plain mean without an attack

    def withstands(self, rule: str) -> bool:
        """Return whether the mean loss of accuracy over seeds is at most `WITHSTOOD`."""
        return self.lost[rule].mean <= WITHSTOOD


@dataclass(frozen=True)
class WithstoodResult(Record):
    """Accuracy by unlikeness, share of attackers, attack and rule."""

    clients: int
    seeds: int
    rows: tuple[Withstood, ...]  # also without an attack
    provenance: Provenance

    def worst(self, unlikeness: str, attackers: int, rule: str) -> Withstood:
        """Return the worst attack for a rule: that with the greatest loss of accuracy."""
        rows = [row for row in self.attacked if (row.unlikeness, row.attackers) == (unlikeness, attackers)]
        return max(rows, key=lambda row: row.lost[rule].mean)

    def rows_of(self, unlikeness: str, attack: str) -> list[Withstood]:
        """Return the rows of an attack, by number of attackers."""
        return [row for row in self.rows if (row.unlikeness, row.attack) == (unlikeness, attack)]

    @property
    def attacked(self) -> list[Withstood]:
        """Return the rows with an attack."""
        return [row for row in self.rows if row.attack != NONE]

    def count(self, rule: str) -> int:
        """Return the number of attacked rows that a rule withstands."""
        return sum(row.withstands(rule) for row in self.attacked)

    def sentences(self) -> list[str]:
        """Return the number of attacks that each rule withstands, in words."""
        return [f"{rule}: withstands {self.count(rule)} of {len(self.attacked)}" for rule in RULES]


def repeat_withstood(
    out: Path, seeds: int, progress: Report = ignore_progress
) -> tuple[WithstoodResult, dict[str, bytes]]:
    """Run the rounds for all rules, attacks, shares, heterogeneities and seeds; nothing is written to `out`."""
    cases = [(name, count, attack) for name in UNLIKENESS for count in ATTACKERS for attack in (NONE, *ATTACKS)]
    accuracy: dict[tuple[str, int, str], dict[str, list[float]]] = {}
    for done, (name, count, attack) in enumerate(cases):
        by_rule = accuracy[name, count, attack] = {rule: [] for rule in RULES}
        for seed in range(1, seeds + 1):
            fleet = draw_fleet(name, seed)
            for rule, strategy in make_rules(count).items():
                weights = run_rounds(fleet, strategy, attack, count, seed)
                by_rule[rule].append(float(find_right(weights, fleet.test).mean()))
        progress(done + 1, len(cases), f"{name}, {count} of {CLIENTS}, {attack}")
    result = summarise_withstood(accuracy, seeds)
    shares = [100 * count / CLIENTS for count in ATTACKERS]
    best = {name: result.rows_of(name, NONE)[0].accuracy["mean"].mean for name in UNLIKENESS}
    return result, {"withstood.png": style.png(draw_withstood(shares, list_worst(result), best))}


def summarise_withstood(
    accuracy: Mapping[tuple[str, int, str], Mapping[str, list[float]]], seeds: int
) -> WithstoodResult:
    """Return the means over seeds, which have different test samples."""
    rows = []
    for (name, count, attack), by_rule in accuracy.items():
        best = np.array(accuracy[name, count, NONE]["mean"])
        means = {rule: mean_over_seeds(values, share=True) for rule, values in by_rule.items()}
        lost = {rule: mean_over_seeds((best - values).tolist()) for rule, values in by_rule.items()}
        rows.append(Withstood(name, count, attack, means, lost))
    return WithstoodResult(CLIENTS, seeds, tuple(rows), provenance())


def list_worst(result: WithstoodResult) -> dict[str, dict[str, list[float]]]:
    """Return the accuracies under the worst attack at each share of attackers, by heterogeneity and rule."""
    return {
        name: {rule: [result.worst(name, count, rule).accuracy[rule].mean for count in ATTACKERS] for rule in RULES}
        for name in UNLIKENESS
    }


COLOURS = {
    "mean": style.MUTED,
    "median": style.BLUE,
    "trimmed mean": style.ORANGE,
    "Krum": style.VERMILLION,
    "multi-Krum": style.GREEN,
}
MIXED = "mixing, "  # prefix of rules with mixing


@style.styled
def draw_withstood(
    shares: Sequence[float], lines: Mapping[str, Mapping[str, Sequence[float]]], best: Mapping[str, float]
) -> Figure:
    """Return the figure of accuracies at `shares` of attackers [%], by panel and rule; `best` are without an attack."""
    figure = style.canvas(9.0, 3.8)
    for number, (name, rules) in enumerate(lines.items(), 1):
        axes = figure.add_subplot(1, len(lines), number)
        axes.axhline(best[name], color=style.INK, linewidth=1, linestyle=(0, (6, 3)), label="mean, no attack")
        for rule, accuracy in rules.items():
            plain = rule.removeprefix(MIXED)
            dash = "-" if rule.startswith(MIXED) else (0, (2, 2))
            axes.plot(shares, accuracy, marker="o", markersize=3.5, color=COLOURS[plain], linestyle=dash, label=rule)
        axes.set(title=name, ylim=(-0.02, 1.02), xlabel="attackers [%]")
        axes.set_xticks(shares)
        axes.grid(axis="y")
        if number > 1:
            axes.set_yticklabels([])
    figure.axes[0].set_ylabel("accuracy under the worst attack")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


THIRTY = 6  # number of attackers, of 20, that one table shows in full


def withstood_tables(results: WithstoodResult) -> dict[str, str]:
    """Return Markdown by name: not withstood, worst, thirty."""
    failing, worst, whole = [], [], []
    for name in UNLIKENESS:
        for count in ATTACKERS:
            share = f"{100 * count // CLIENTS} %"
            rows = [row for row in results.attacked if (row.unlikeness, row.attackers) == (name, count)]
            names = [", ".join(row.attack for row in rows if not row.withstands(rule)) or "–" for rule in RULES]
            failing.append([name, share, *names])
            hardest = [results.worst(name, count, rule).accuracy[rule].mean for rule in RULES]
            worst.append([name, share, *(f"{accuracy:.2f}" for accuracy in hardest)])
        for attack in (NONE, *ATTACKS):
            (row,) = [one for one in results.rows_of(name, attack) if one.attackers == THIRTY]
            whole.append([name, attack, *(row.accuracy[rule].describe() for rule in RULES)])
    counts = ["all", "", *(f"{results.count(rule)} of {len(results.attacked)} withstood" for rule in RULES)]
    return {
        "not withstood": format_table(("data", "attackers", *RULES), [*failing, counts]),
        "worst": format_table(("data", "attackers", *RULES), worst),
        "thirty": format_table((f"data, {THIRTY} of {CLIENTS} attack", "attack", *RULES), whole),
    }


def _run(out: Path, options: Options) -> Outcome[WithstoodResult]:
    with options.show_progress(options.title) as report:
        results, pictures = repeat_withstood(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(WithstoodResult, _run, withstood_tables, seeds=5, takes=("seeds",))
