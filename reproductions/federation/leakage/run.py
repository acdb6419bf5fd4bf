"""Leakage against noise: accuracy of a federation, and what its server can tell about the vehicles' pictures.

The server is curious and sees each update, so that noise is added by the vehicles themselves; or it sees masked updates
and their sum alone.
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
    """Return the input of layer F6 (120,) that explains the change of its weights and biases best.

    x = sum_i b_i W_i / sum_i b_i^2 over rows W_i and biases b_i of the change; zeros where no bias changed.
    """
    rows = np.asarray(sent[f"{HIDDEN}.weight"], np.float64) - start[f"{HIDDEN}.weight"]
    biases = np.asarray(sent[f"{HIDDEN}.bias"], np.float64) - start[f"{HIDDEN}.bias"]
    return (biases @ rows / max(float(biases @ biases), 1e-30)).astype(np.float32)


def name_nearest(found: Vector, known: Vector) -> int:
    """Return which of the known inputs (N, 120) has the largest cosine similarity with the one that was found."""
    return int(np.argmax(known @ found / np.maximum(np.linalg.norm(known, axis=1), 1e-12)))


def membership_auc(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the chance that a member has a lower loss than another picture, ties counted half."""
    less = members[:, None] < others[None]
    same = members[:, None] == others[None]
    return float(less.mean() + same.mean() / 2)


def membership_advantage(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the shares of members and of others with a loss up to the members' mean, one less the other."""
    limit = members.mean()
    return float((members <= limit).mean() - (others <= limit).mean())


NOISES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # standard deviation as a multiple of the clipping norm
CLIP, DELTA = 1.0, 1e-5
PICTURES, ROUNDS, STEPS, LEARNING_RATE = 16, 10, 20, 0.05  # pictures of each vehicle
LONG_STEP = 1.0  # rate of the single step on one picture: longer than what clipping leaves of it


@dataclass(frozen=True)
class Leaked:
    """Accuracy and leakage of one seed, or the means over seeds by the name of each number."""

    accuracy: float  # on held-out drives
    membership_auc: float  # 0.5: members cannot be told from others
    membership_advantage: float
    recognised_one: float  # share of vehicles whose picture the inversion of a step on one picture names
    recognised_round: float  # share of vehicles of which the inversion of a whole update names a picture


@dataclass(frozen=True)
class Attacked:
    """A federation of one seed that was attacked."""

    by_update: Leaked  # by each vehicle's update
    by_sum: Leaked  # by the mean of all
    right: NDArray[np.bool_]  # (N,) whether the network at its end names the class of each picture of the test


@dataclass(frozen=True)
class NoiseLevel:
    """One amount of noise, or secure aggregation."""

    name: str
    epsilon: float | None  # of a vehicle's whole data after all rounds, at delta; None: unbounded
    seeds: tuple[Leaked, ...]
    mean: Mapping[str, MeanOverSeeds]  # by name of the numbers


@dataclass(frozen=True)
class LeakageResult(Record):
    """Accuracy and leakage by amount of noise, and under secure aggregation."""

    pictures: int  # that a picture is to be recognised among
    clip: float
    delta: float
    rounds: int
    levels: tuple[NoiseLevel, ...]  # ascending noise
    masked: NoiseLevel  # a single masked update
    summed: NoiseLevel  # the sum of all updates, which secure aggregation shows
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return a sentence per level, and one on what epsilon rests on."""
        told = []
        for level in (*self.levels, self.masked, self.summed):
            epsilon = "" if level.epsilon is None else f" (epsilon {level.epsilon:.3g})"
            numbers = ", ".join(f"{name} {mean.mean:.3f}" for name, mean in level.mean.items())
            told.append(f"{level.name}{epsilon}: {numbers}")
        return [*told, f"noise: {SEEDED}"]


def repeat_leakage(out: Path, seeds: int, progress: Report = ignore_progress) -> tuple[LeakageResult, dict[str, bytes]]:
    """Record the drives into `out`, federate and attack; return the numbers, and the figure as PNG by file name."""
    drives = record_drives(out, progress)
    known = np.concatenate([each.features for each in drives.vehicles.values()])
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
    lines = {
        "accuracy": [level.mean["accuracy"] for level in levels],
        "membership, area under the curve": [level.mean["membership_auc"] for level in levels],
        "picture recognised, of a step on one": [level.mean["recognised_one"] for level in levels],
        "picture recognised, of an update": [level.mean["recognised_round"] for level in levels],
    }
    ticks = [f"{level.name}\n{'∞' if level.epsilon is None else f'{level.epsilon:.2g}'}" for level in levels]
    return results, {"leakage.png": style.png(draw_leakage(ticks, lines))}


def split_members(drives: Drives, seed: int) -> tuple[dict[str, Pictures], dict[str, Pictures]]:
    """Return the pictures that each vehicle trains on, and as many others of the same drives that nobody sees."""
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
    """Return accuracy and leakage of a federation under these rules.

    known: (N, 120), the pictures that one is to be recognised among.
    """
    members, others = split_members(drives, seed)
    first = {name: take(pictures, [0]) for name, pictures in members.items()}
    start, account = draw_head(seed), Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", WEATHER.name, "wireless")
    schedule = Schedule(ROUNDS, STEPS, LEARNING_RATE, LEARNING_RATE / 4, seed)
    vehicles = {name: Vehicle(pictures) for name, pictures in members.items()}
    single = {name: Vehicle(pictures, 1) for name, pictures in first.items()}
    final = federate(vehicles, start, schedule, account, rules=rules).weights
    losses = [np.concatenate([measure_losses(final, each) for each in part.values()]) for part in (members, others)]
    right = find_right(final, drives.test)
    told = (float(right.mean()), membership_auc(*losses), membership_advantage(*losses))
    seen_one, mean_one = read_round(single, start, Schedule(1, 1, LONG_STEP, LONG_STEP, seed).work, rules)
    seen, mean = read_round(vehicles, start, schedule.work, rules)

    def tell(sent_one: Mapping[str, Weights], sent: Mapping[str, Weights]) -> Leaked:
        one, whole = share_recognised(start, sent_one, first, known), share_recognised(start, sent, members, known)
        return Leaked(*told, one, whole)

    by_sum = tell(dict.fromkeys(members, mean_one), dict.fromkeys(members, mean))
    return Attacked(tell(seen_one, seen), by_sum, right)


def share_recognised(start: Weights, sent: Mapping[str, Weights], own: Mapping[str, Pictures], known: Vector) -> float:
    """Return the share of vehicles of which the inversion of what was sent names one of its own pictures."""
    named = {name: known[name_nearest(invert(start, weights), known)] for name, weights in sent.items()}
    return float(np.mean([(own[name].features == found).all(axis=1).any() for name, found in named.items()]))


def make_level(
    test: Pictures, name: str, epsilon: float | None, seeds: Sequence[Attacked], *, by_sum: bool = False
) -> NoiseLevel:
    """Return a level with the means over its seeds: of the accuracy over the scenes of `test`, too."""
    leaked = tuple(each.by_sum if by_sum else each.by_update for each in seeds)
    spread = {"accuracy": spread_over_scenes(test, [each.right.astype(float) for each in seeds])}
    means = {}
    for key in (field.name for field in fields(Leaked)):
        values = [getattr(each, key) for each in leaked]
        share = key != "membership_advantage"
        means[key] = mean_over_seeds(values, share=share, shared=spread.get(key, OWN_SCENES))
    return NoiseLevel(name, epsilon, leaked, means)


COLOURS = (style.BLUE, style.VERMILLION, style.ORANGE, style.PURPLE)
NAME_HEIGHT = 0.07  # of the axes: a line of text


@style.styled
def draw_leakage(levels: Sequence[str], lines: Mapping[str, Sequence[MeanOverSeeds]]) -> Figure:
    """Return the figure of shares in [0, 1], a line for each name; `levels` are the ticks' texts, noise and epsilon."""
    figure = style.canvas(8.6, 3.9)
    axes = figure.add_subplot()
    ends = style.keep_apart([line[0].mean for line in lines.values()], NAME_HEIGHT, 1.03)
    for (name, line), colour, end in zip(lines.items(), COLOURS, ends, strict=True):
        axes.plot(range(len(levels)), [each.mean for each in line], "o-", color=colour, markersize=4)
        for x, each in enumerate(line):
            style.interval(axes, x, each, color=colour, linewidth=1)
        axes.annotate(name, (-0.15, end), color=colour, va="center", ha="right", fontsize=style.SMALL)
    axes.axhline(0.5, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set_xticks(range(len(levels)), levels)
    axes.set(xlabel="noise of each vehicle, as a multiple of the clipping norm; below: ε", ylim=(-0.02, 1.04))
    axes.set_xlim(-3.4, len(levels) - 0.7)
    axes.spines["left"].set_visible(False)
    axes.yaxis.tick_right()
    axes.grid(axis="y")
    return figure


class ReadGrid(LinkGrid):
    """A grid whose server keeps the arrays of each client's last update as they were sent."""

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
    """Return what the server makes of each client's update in the first round, and the weights after it.

    work: of a round, counted from 1 (`Schedule.work`).
    Of a masked update it takes the integers for a change of the weights.
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
            ("what the server sees", *names.values()), [[name, *row(each)] for name, each in shown.items()]
        ),
    }


def _run(out: Path, options: Options) -> Outcome[LeakageResult]:
    with options.show_progress(options.title) as report:
        results, pictures = repeat_leakage(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(LeakageResult, _run, leakage_tables, seeds=5, takes=("seeds",))
