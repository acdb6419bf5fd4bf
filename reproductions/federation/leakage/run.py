"""Leakage by amount of noise: accuracy of a federation, and attacks of its server on the privacy of vehicles' pictures.

The server is honest but curious. It sees every update, with local noise of the vehicles, or only masked updates and
their sum.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from flwr.app import Message
from flwr.serverapp import Grid
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.client import client_app
from flcav.federation.links.in_process import EmbeddedGrid, LinkGrid
from flcav.federation.links.metered import Account
from flcav.federation.loop import FederationServer, Schedule, federate
from flcav.federation.privacy import SEEDED, Privacy, account_epsilon, draw_secret
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.secure.primitives import to_values
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import Trainable, Weights
from flcav.federation.wire import ARRAYS, VECTOR, LocalWork, decode_update, read_arrays, unflatten
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.weather.task import WEATHER
from flcav.report import style
from flcav.report.charts.runs import name_measure
from flcav.reproductions.federation.drives import (
    HIDDEN,
    Drives,
    Pictures,
    Vector,
    Vehicle,
    draw_head,
    find_right,
    measure_losses,
    record_drives,
    spread_over_scenes,
)
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import OWN_SCENES, MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record


def invert(start: Weights, sent: Weights) -> Vector:
    """Return the least-squares estimate of the input of layer F6 (120,) from the change of its weights and biases.

    x = sum_i b_i W_i / sum_i b_i^2 over rows W_i and biases b_i of the change; zeros if no bias changed.
    """
    # The gradient of a fully connected layer for one sample is W_i = b_i x: every row of the change reveals the input.
    rows = np.asarray(sent[f"{HIDDEN}.weight"], np.float64) - start[f"{HIDDEN}.weight"]
    biases = np.asarray(sent[f"{HIDDEN}.bias"], np.float64) - start[f"{HIDDEN}.bias"]
    return (biases @ rows / max(float(biases @ biases), 1e-30)).astype(np.float32)


def name_nearest(found: Vector, known: Vector) -> int:
    """Return the index of the known input (N, 120) with the largest cosine similarity to `found` (120,)."""
    return int(np.argmax(known @ found / np.maximum(np.linalg.norm(known, axis=1), 1e-12)))


def membership_auc(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the AUC of membership inference by loss: the probability that a member's loss is lower than another's."""
    less = members[:, None] < others[None]
    same = members[:, None] == others[None]
    return float(less.mean() + same.mean() / 2)


def membership_advantage(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the membership advantage: the share of members less that of others with a loss up to the members' mean."""
    limit = members.mean()
    return float((members <= limit).mean() - (others <= limit).mean())


NOISES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # standard deviation as a multiple of the clipping norm
CLIP, DELTA = 1.0, 1e-5
PICTURES, ROUNDS, STEPS, LEARNING_RATE = 16, 10, 20, 0.05  # pictures of each vehicle
LONG_STEP = 1.0  # rate of the single step on one picture: long enough to be clipped


@dataclass(frozen=True)
class Leaked:
    """Accuracy and leakage of one seed."""

    accuracy: float  # on held-out drives
    membership_auc: float  # 0.5: members cannot be distinguished from others
    membership_advantage: float
    recognised_one: float  # share of vehicles whose picture is recognised by inverting a step on one picture
    recognised_round: float  # share of vehicles with a picture recognised by inverting a whole update


@dataclass(frozen=True)
class Attacked:
    """Results of the attacks on a federation with one seed."""

    by_update: Leaked  # from the vehicles' updates
    by_sum: Leaked  # from the mean of all updates
    right: NDArray[np.bool_]  # (N,) correct pictures of the test, by the final network


@dataclass(frozen=True)
class NoiseLevel:
    """Results for one amount of noise, or for secure aggregation."""

    name: str
    epsilon: float | None  # of a vehicle's whole data after all rounds, at delta; None: unbounded
    seeds: tuple[Leaked, ...]
    mean: Mapping[str, MeanOverSeeds]  # by field of `Leaked`


@dataclass(frozen=True)
class LeakageResult(Record):
    """Accuracy and leakage by amount of noise, and under secure aggregation."""

    pictures: int  # number of pictures among which one is recognised
    clip: float
    delta: float
    rounds: int
    levels: tuple[NoiseLevel, ...]  # by ascending noise
    masked: NoiseLevel  # attacks on masked updates
    summed: NoiseLevel  # attacks on the sum, which secure aggregation reveals
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return a sentence per level, and one on the randomness that epsilon relies on."""
        lines = []
        for level in (*self.levels, self.masked, self.summed):
            epsilon = "" if level.epsilon is None else f" (epsilon {level.epsilon:.3g})"
            numbers = ", ".join(f"{name} {mean.mean:.3f}" for name, mean in level.mean.items())
            lines.append(f"{level.name}{epsilon}: {numbers}")
        return [*lines, f"noise: {SEEDED}"]


def repeat_leakage(out: Path, seeds: int, progress: Report = ignore_progress) -> tuple[LeakageResult, dict[str, bytes]]:
    """Record the drives to `out`, federate and attack; return the results, and the figure as PNG by file name."""
    drives = record_drives(out, progress)
    known = np.concatenate([pictures.features for pictures in drives.vehicles.values()])
    names, levels, done = [*drives.vehicles], [], 0
    for noise in NOISES:
        privacy = Privacy(where="local", clip=CLIP, noise=noise, delta=DELTA, seeded=True) if noise else None
        found = []
        for seed in range(1, seeds + 1):
            found.append(attack(drives, known, Rules(privacy=privacy), seed))
            done += 1
            progress(done, (len(NOISES) + 1) * seeds, f"noise {noise:g}, seed {seed}")
        epsilon = None if privacy is None else account_epsilon(privacy, Selection(), names, ROUNDS)
        levels.append(make_level(drives.test, f"{noise:g}" if noise else "none", epsilon, found))
    secure = [attack(drives, known, Rules(secure=SecureAggregation()), seed) for seed in range(1, seeds + 1)]
    masked = make_level(drives.test, "masked update", None, secure)
    summed = make_level(drives.test, "sum of all", None, secure, by_sum=True)
    results = LeakageResult(len(known), CLIP, DELTA, ROUNDS, tuple(levels), masked, summed, provenance())
    return results, {"leakage.png": draw_results(results)}


def draw_results(results: LeakageResult) -> bytes:
    """Return the chart of accuracy and attacks by noise as a PNG."""
    levels = results.levels
    lines = {
        "accuracy": [level.mean["accuracy"] for level in levels],
        "membership, area under the curve": [level.mean["membership_auc"] for level in levels],
        "picture recognised, of a step on one": [level.mean["recognised_one"] for level in levels],
        "picture recognised, of an update": [level.mean["recognised_round"] for level in levels],
    }
    ticks = [f"{level.name}\n{'∞' if level.epsilon is None else f'{level.epsilon:.2g}'}" for level in levels]
    return style.png(draw_leakage(ticks, lines))


def split_members(drives: Drives, seed: int) -> tuple[dict[str, Pictures], dict[str, Pictures]]:
    """Return the pictures that each vehicle trains on, and equally many of the same drives that are not used."""
    members, others = {}, {}
    for name, seen in drives.vehicles.items():
        order = stream(seed, "members", name).permutation(len(seen.labels))
        members[name], others[name] = take(seen, order[:PICTURES]), take(seen, order[PICTURES : 2 * PICTURES])
    return members, others


def take(pictures: Pictures, places: Sequence[int] | NDArray[np.int64]) -> Pictures:
    """Return the pictures at these places."""
    scenes = tuple(pictures.scenes[place] for place in places)
    return Pictures(pictures.features[places], pictures.labels[places], scenes)


def attack(drives: Drives, known: Vector, rules: Rules, seed: int) -> Attacked:
    """Run a federation under `rules`, attack it, and return its accuracy and leakage.

    `known` (N, 120) are the features of the pictures among which one is recognised.
    """
    members, others = split_members(drives, seed)
    first = {name: take(pictures, [0]) for name, pictures in members.items()}
    start = draw_head(seed)
    account = Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", WEATHER.name, "wireless")
    schedule = Schedule(ROUNDS, STEPS, LEARNING_RATE, LEARNING_RATE / 4, seed)
    vehicles = {name: Vehicle(pictures) for name, pictures in members.items()}
    single = {name: Vehicle(pictures, 1) for name, pictures in first.items()}
    final = federate(vehicles, start, schedule, account, rules=rules).weights
    losses = [np.concatenate([measure_losses(final, seen) for seen in part.values()]) for part in (members, others)]
    right = find_right(final, drives.test)
    of_network = (float(right.mean()), membership_auc(*losses), membership_advantage(*losses))
    seen_one, mean_one = read_round(single, start, Schedule(1, 1, LONG_STEP, LONG_STEP, seed).work, rules)
    seen, mean = read_round(vehicles, start, schedule.work, rules)

    def measure(sent_one: Mapping[str, Weights], sent: Mapping[str, Weights]) -> Leaked:
        one = share_recognised(start, sent_one, first, known)
        whole = share_recognised(start, sent, members, known)
        return Leaked(*of_network, one, whole)

    by_sum = measure(dict.fromkeys(members, mean_one), dict.fromkeys(members, mean))
    return Attacked(measure(seen_one, seen), by_sum, right)


def share_recognised(
    start: Weights, sent: Mapping[str, Weights], pictures: Mapping[str, Pictures], known: Vector
) -> float:
    """Return the share of vehicles for which the inversion of the sent weights recognises one of their pictures."""
    named = {name: known[name_nearest(invert(start, weights), known)] for name, weights in sent.items()}
    return float(np.mean([(pictures[name].features == found).all(axis=1).any() for name, found in named.items()]))


def make_level(
    test: Pictures, name: str, epsilon: float | None, seeds: Sequence[Attacked], *, by_sum: bool = False
) -> NoiseLevel:
    """Return a level with the means over its seeds; the interval of the accuracy also covers the scenes of `test`."""
    leaked = tuple(attacked.by_sum if by_sum else attacked.by_update for attacked in seeds)
    spread = {"accuracy": spread_over_scenes(test, [attacked.right.astype(float) for attacked in seeds])}
    means = {}
    for key in (field.name for field in fields(Leaked)):
        values = [getattr(one, key) for one in leaked]
        share = key != "membership_advantage"
        means[key] = mean_over_seeds(values, share=share, shared=spread.get(key, OWN_SCENES))
    return NoiseLevel(name, epsilon, leaked, means)


COLOURS = (style.BLUE, style.VERMILLION, style.ORANGE, style.PURPLE)


@style.styled
def draw_leakage(levels: Sequence[str], lines: Mapping[str, Sequence[MeanOverSeeds]]) -> Figure:
    """Return the chart of shares in [0, 1], a line per name; `levels` are the labels of ticks, noise and epsilon."""
    figure = style.canvas(8.6, 3.9)
    axes = figure.add_subplot()
    for (name, line), colour in zip(lines.items(), COLOURS, strict=True):
        axes.plot(range(len(levels)), [mean.mean for mean in line], "o-", color=colour, markersize=4, label=name)
        for x, mean in enumerate(line):
            style.interval(axes, x, mean, color=colour, linewidth=1)
    axes.axhline(0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.annotate("chance of membership", (0.22, 0.5), (0, -11), xycoords=axes.get_yaxis_transform(), ha="center",
                  textcoords="offset points", color=style.MUTED, fontsize=style.SMALL)  # fmt: skip
    axes.set_xticks(range(len(levels)), levels)
    axes.set(xlabel="noise of each vehicle, as a multiple of the clipping norm; below: ε", ylim=(-0.02, 1.04))
    share = name_measure("share", (mean for line in lines.values() for mean in line))
    axes.set(ylabel=share, xlim=(-0.2, len(levels) - 0.8))
    axes.grid(axis="y")
    style.key(figure, axes.get_legend_handles_labels()[0], ncols=2)
    return figure


class ReadGrid(LinkGrid):
    """A grid whose server keeps the clients' last updates as they were sent."""

    def __init__(self, grid: Grid, names: Mapping[int, str]) -> None:
        self._grid, self.names = grid, names
        self.updates: dict[str, Weights] = {}

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        """Yield the replies, and keep those that are updates."""
        for reply in self._grid.send_and_receive(messages, timeout=timeout):
            if reply.has_content() and ARRAYS in reply.content:
                self.updates[self.names[reply.metadata.src_node_id]] = read_arrays(reply.content, ARRAYS)
            yield reply


def read_round(
    clients: Mapping[str, Trainable], start: Weights, work: Callable[[int], LocalWork], rules: Rules
) -> tuple[dict[str, Weights], Weights]:
    """Run the first round; return the weights that the server decodes from each update, and the weights after it.

    `work` returns the local work of a round, counted from 1 (`Schedule.work`). The integers of a masked update are
    decoded as a change of the weights.
    """
    secrets = {party: draw_secret() for party in rules.secret_parties([*clients]) if party in clients}
    with EmbeddedGrid(client_app(clients, FEDAVG, rules, secrets), [*clients]) as grid:
        reading = ReadGrid(grid, grid.names)
        after = dict(FederationServer(reading, grid.names, FEDAVG, rules, work, FederationState()).run_round(1, start))
    seen: dict[str, Weights] = {}
    for name, update in reading.updates.items():
        if rules.secure is None:
            seen[name] = decode_update(update, start, rules)
        else:
            vector = np.asarray(update[VECTOR], np.uint32)
            seen[name] = unflatten(to_values(vector, rules.secure.largest, len(clients)), start, rules)
    return seen, after


def leakage_tables(results: LeakageResult) -> dict[str, str]:
    """Return Markdown by name: levels, secure."""
    names = {
        "accuracy": "accuracy",
        "membership_auc": "membership: area under the curve",
        "membership_advantage": "advantage",
        "recognised_one": "picture recognised, of a step on one",
        "recognised_round": "of an update",
    }

    def row(level: NoiseLevel) -> list[str]:
        return [level.mean[name].describe() for name in names]

    levels = [
        [level.name, "∞" if level.epsilon is None else f"{level.epsilon:.3g}", *row(level)] for level in results.levels
    ]
    shown = {"every update": results.levels[0], "a masked update": results.masked, "the sum of all": results.summed}
    return {
        "levels": format_table(("noise", "ε", *names.values()), levels),
        "secure": format_table(
            ("what the server sees", *names.values()), [[name, *row(level)] for name, level in shown.items()]
        ),
    }


def _run(out: Path, options: Options) -> Outcome[LeakageResult]:
    with options.show_progress(options.title) as report:
        results, pictures = repeat_leakage(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(LeakageResult, _run, leakage_tables, seeds=5, takes=("seeds",))
