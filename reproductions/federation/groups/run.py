"""Groups on request compared with a fixed roster: accuracy by uplink, at equal megabytes and after the whole plan.

Ten vehicles drive with a network that was trained on six of eight weathers. In one setting all of them meet the other
two, in the other only three do. A group is formed as in stage II of a run (`flcav.runs.extras.groups.choosing`):
vehicles with large losses request it, all vehicles offer their data, the lead chooses members by these offers, and the
group dissolves when its loss on held-back pictures has levelled off.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.experiments.comparison import Differences, describe_differences, tabulate_verdicts
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.federation.links.metered import Account
from flcav.federation.loop import EVERYBODY, Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.trainable import Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import BYTES_PER_MB, Ledger, LinkMegabytes, pack_arrays, send_message
from flcav.perception.weather.task import WEATHER
from flcav.report import style
from flcav.reproductions.federation.drives import (
    Drives,
    Vehicle,
    average_pictures,
    find_right,
    measure_losses,
    record_drives,
)
from flcav.reproductions.federation.groups.vehicles import Fleet, make_offer, open_fleet
from flcav.runs.extras.groups.choosing import choose_members, has_levelled, weigh_offers
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE
from flcav.runs.stages.rounds import RoundsOver
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

ROUNDS, STEPS, LEARNING_RATE = 20, 5, 0.05
REQUESTS = Requests(excess=50.0, most=4)
TARGET = 0.95  # accuracy
ROSTER, GROUP, DRAWN = "fixed roster, all ten", "group on request", "four drawn for each round"
RIVALS = (ROSTER, GROUP, DRAWN)
UNLIKE, ALIKE = "three meet two new weathers", "all meet two new weathers"
SETTINGS = (UNLIKE, ALIKE)
MEGABYTES, WHOLE = "the group's megabytes", "the whole plan"
MEASURES = (MEGABYTES, WHOLE)  # of accuracy
UNTIL = f"megabytes until accuracy {TARGET}"
UP: Any = {"stage": EDGE, "task": WEATHER.name, "link": "wireless", "direction": "up"}


@dataclass(frozen=True)
class Trajectory:
    """A federation with one seed: uplink and accuracy on the test drives, before the first and after each round."""

    up_mb: tuple[float, ...]  # cumulated [MB]
    accuracy: tuple[float, ...]
    members: tuple[str, ...]  # of all rounds, or those from which clients are drawn
    asked: tuple[str, ...] = ()  # vehicles that requested the group
    at: Mapping[str, float] | None = None  # accuracy by `MEASURES`
    gain_per_mb: Mapping[str, float] | None = None  # gain in accuracy since pretraining per MB, by `MEASURES`
    until_mb: float | None = None  # uplink until `TARGET` [MB], at most that of the roster's whole plan


@dataclass(frozen=True)
class GroupsResult(Record):
    """Results by setting: trajectories by seed and method, means over seeds, and differences to the fixed roster."""

    pictures: int  # number in the test
    scenes: int
    meet: Mapping[str, tuple[str, ...]]  # by seed, the vehicles that meet the new weathers if only three do
    trajectories: Mapping[str, Mapping[str, Mapping[str, Trajectory]]]  # by setting, seed and rival
    accuracy: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by setting, measure and rival
    gains: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # per megabyte
    until_mb: Mapping[str, Mapping[str, MeanOverSeeds]]  # by setting and rival
    differences: Differences  # of accuracy; megabytes saved until `TARGET`
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the differences in words."""
        return describe_differences(self.differences, "roster")


@dataclass(frozen=True)
class Followed:
    """Course of a federation: its weights and uplink before the first and after each round, and its vehicles."""

    weights: tuple[Weights, ...]
    up_bytes: tuple[int, ...]  # cumulated
    members: tuple[str, ...]
    asked: tuple[str, ...] = ()  # vehicles that requested the group

    def last_within(self, up_bytes: int) -> int:
        """Return the last round until which at most `up_bytes` bytes are sent."""
        return int(np.flatnonzero(np.array(self.up_bytes) <= up_bytes)[-1])


def compare_groups(
    out: Path, seeds: int, progress: Report = ignore_progress, *, first: int = 1
) -> tuple[GroupsResult, dict[str, bytes]]:
    """Record the drives to `out`, federate by each setting, seed and method, and return results and a picture."""
    drives = record_drives(out, progress)
    right: dict[tuple[str, str, str], list[NDArray[np.float64]]] = {}
    found: dict[str, dict[str, dict[str, Trajectory]]] = {setting: {} for setting in SETTINGS}
    meet: dict[str, tuple[str, ...]] = {}
    total, done = seeds * len(SETTINGS), 0
    for seed in range(first, first + seeds):
        for setting in SETTINGS:
            fleet = open_fleet(drives, seed, alike=setting == ALIKE, held_back=REQUESTS.held_back)
            if setting == UNLIKE:
                meet[str(seed)] = fleet.meet
            followed = {GROUP: call(fleet, seed), ROSTER: keep(fleet, seed), DRAWN: draw(fleet, seed)}
            found[setting][str(seed)], marks = score(followed, drives)
            for key, correct in marks.items():
                right.setdefault((setting, *key), []).append(correct)
            done += 1
            progress(done, total, f"seed {seed}, {setting}")
    results = summarise(drives, meet, found, right)
    return results, {"groups.png": style.png(draw_by_megabytes(results.trajectories, RIVALS))}


def keep(fleet: Fleet, seed: int) -> Followed:
    """Return the rounds of the fixed roster: all vehicles, with all of their pictures."""
    return follow(fleet, seed, Ledger(LinkMegabytes(1e6, 0.0)), [*fleet.whole])


def draw(fleet: Fleet, seed: int) -> Followed:
    """Return rounds with as many vehicles as the largest group, drawn for each round, with all of their pictures."""
    rules = Rules(selection=Selection(rule="uniform", clients=REQUESTS.most))
    return follow(fleet, seed, Ledger(LinkMegabytes(1e6, 0.0)), [*fleet.whole], rules)


def call(fleet: Fleet, seed: int) -> Followed:
    """Return the rounds of a group; vehicles with a loss on held-back pictures above the limit request it."""
    book = Ledger(LinkMegabytes(1e6, 0.0))
    limit = REQUESTS.excess * fleet.loss
    losses = {name: float(measure_losses(fleet.start, held).mean()) for name, held in fleet.held.items()}
    asked = sorted((name for name, loss in losses.items() if loss > limit), key=lambda name: -losses[name])
    if not asked:
        return Followed((fleet.start,), (0,), ())
    for name in asked:
        about = {"position": np.zeros(3, np.float32), "loss": np.array([losses[name]], np.float32)}
        send_message(book, pack_arrays(about), client=name, **UP)
    offers = {name: make_offer(pictures, fleet.start, seed) for name, pictures in fleet.train.items()}
    for name, offer in offers.items():
        send_message(book, offer.message(), client=name, **UP)
    chosen = choose_members(REQUESTS, asked, weigh_offers(offers), {})
    return follow(fleet, seed, book, chosen.members, asked=asked)


def follow(
    fleet: Fleet, seed: int, book: Ledger, members: Sequence[str], rules: Rules = EVERYBODY, asked: Sequence[str] = ()
) -> Followed:
    """Return the rounds of the `members`; a group, requested by `asked`, dissolves when its loss has levelled off."""
    kept = [fleet.start]
    report = pack_arrays({"loss": np.zeros(1, np.float32)})
    held = [fleet.held[name] for name in members]
    losses = [float(np.mean([measure_losses(fleet.start, pictures).mean() for pictures in held]))]

    def after(number: int, weights: Weights, _loss: float | None) -> None:
        kept.append(weights)
        if asked:
            losses.append(float(np.mean([measure_losses(weights, pictures).mean() for pictures in held])))
            for name in members:
                send_message(book, report, client=name, round_=number, **UP)
            if has_levelled(losses, REQUESTS):
                raise RoundsOver

    pictures = fleet.train if asked else fleet.whole
    with suppress(RoundsOver):
        federate(
            {name: Vehicle(pictures[name]) for name in sorted(members)},
            fleet.start,
            Schedule(ROUNDS, STEPS, LEARNING_RATE, LEARNING_RATE, seed),
            Account(book, EDGE, WEATHER.name, "wireless"),
            rules=rules,
            on_round=after,
        )
    sent = [sum(e.bytes for e in book if e.direction == "up" and e.round <= number) for number in range(len(kept))]
    return Followed(tuple(kept), tuple(sent), tuple(members), tuple(asked))


def score(
    followed: Mapping[str, Followed], drives: Drives
) -> tuple[dict[str, Trajectory], dict[tuple[str, str], NDArray[np.float64]]]:
    """Return the trajectories by method, and the correct test pictures (N,) by measure and method."""
    found: dict[str, Trajectory] = {}
    marks: dict[tuple[str, str], NDArray[np.float64]] = {}
    group_bytes, most_mb = followed[GROUP].up_bytes[-1], followed[ROSTER].up_bytes[-1] / BYTES_PER_MB
    for name, course in followed.items():
        right = [find_right(weights, drives.test).astype(float) for weights in course.weights]
        mb = [sent / BYTES_PER_MB for sent in course.up_bytes]
        ends = {MEGABYTES: course.last_within(group_bytes), WHOLE: len(right) - 1}
        at = {measure: float(right[end].mean()) for measure, end in ends.items()}
        gain = {m: (at[m] - float(right[0].mean())) / mb[end] if end else 0.0 for m, end in ends.items()}
        accuracy = tuple(round(float(correct.mean()), 5) for correct in right)
        until = next((sent for sent, value in zip(mb, accuracy, strict=True) if value >= TARGET), most_mb)
        reached = (at, gain, round(min(until, most_mb), 4))
        found[name] = Trajectory(tuple(np.round(mb, 4).tolist()), accuracy, course.members, course.asked, *reached)
        marks |= {(measure, name): right[end] for measure, end in ends.items()}
    return found, marks


def summarise(
    drives: Drives,
    meet: Mapping[str, tuple[str, ...]],
    found: Mapping[str, Mapping[str, Mapping[str, Trajectory]]],
    right: Mapping[tuple[str, str, str], list[NDArray[np.float64]]],
) -> GroupsResult:
    """Return the means over seeds; these share the scenes of the test."""

    def gain(setting: str, measure: str, rival: str) -> MeanOverSeeds:
        gains = [seed[rival].gain_per_mb for seed in found[setting].values()]
        return mean_over_seeds([by_measure[measure] for by_measure in gains if by_measure is not None])

    def difference(setting: str, measure: str, rival: str) -> MeanOverSeeds:
        pairs = zip(right[setting, measure, rival], right[setting, measure, ROSTER], strict=True)
        return average_pictures(drives.test, [one - other for one, other in pairs], share=False)

    def until(setting: str, rival: str) -> list[float]:
        return [seed[rival].until_mb or 0.0 for seed in found[setting].values()]

    def saved(setting: str, rival: str) -> MeanOverSeeds:
        return mean_over_seeds([a - b for a, b in zip(until(setting, ROSTER), until(setting, rival), strict=True)])

    others = [rival for rival in RIVALS if rival != ROSTER]
    return GroupsResult(
        pictures=len(drives.test.scenes),
        scenes=len(set(drives.test.scenes)),
        meet=meet,
        trajectories=found,
        accuracy={
            s: {m: {n: average_pictures(drives.test, right[s, m, n], share=True) for n in RIVALS} for m in MEASURES}
            for s in SETTINGS
        },
        gains={s: {m: {n: gain(s, m, n) for n in RIVALS} for m in MEASURES} for s in SETTINGS},
        until_mb={s: {n: mean_over_seeds(until(s, n)) for n in RIVALS} for s in SETTINGS},
        differences={
            s: {m: {n: difference(s, m, n) for n in others} for m in MEASURES}
            | {UNTIL: {n: saved(s, n) for n in others}}
            for s in SETTINGS
        },
        provenance=provenance(),
    )


def groups_tables(results: GroupsResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, groups, differences."""
    accuracy = list[list[str]]()
    groups = list[list[str]]()
    claims: dict[tuple[str, ...], MeanOverSeeds] = {}
    for setting in SETTINGS:
        seeds = results.trajectories[setting]
        for rival in RIVALS:
            by_seed = [seed[rival] for seed in seeds.values()]
            means = [results.accuracy[setting][measure][rival].describe() for measure in MEASURES]
            gain = results.gains[setting][WHOLE][rival].describe()
            rounds = np.mean([len(one.up_mb) - 1 for one in by_seed])
            sent = np.mean([one.up_mb[-1] for one in by_seed])
            until = results.until_mb[setting][rival].describe()
            accuracy.append([setting, rival, *means, f"{rounds:.1f}", f"{sent:.2f}", gain, until])
            for measure in (*MEASURES, UNTIL) if rival != ROSTER else ():
                claims[setting, measure, rival] = results.differences[setting][measure][rival]
        for seed, rivals in sorted(seeds.items(), key=lambda item: int(item[0])):
            group = rivals[RIVALS[1]]
            names = (", ".join(group.asked), ", ".join(group.members))
            met = ", ".join(results.meet[seed]) if setting == SETTINGS[0] else "all"
            groups.append([setting, seed, met, *names, str(len(group.up_mb) - 1), f"{group.up_mb[0] * 1000:.1f}"])
    heads = (
        f"vehicles, {len(results.meet)} seeds",
        "rounds",
        f"accuracy at {MEGABYTES}",
        "accuracy after the whole plan",
        "rounds until its end",
        "MB up by then",
        "gain in accuracy per MB of it",
        f"MB up until accuracy {TARGET}",
    )
    of_groups = ("vehicles", "seed", "met the new weathers", "asked", "came", "rounds", "requests and offers, kB")
    compared = "accuracy - fixed roster's, or megabytes saved"
    return {
        "accuracy": format_table(heads, accuracy),
        "groups": format_table(of_groups, groups),
        "differences": tabulate_verdicts(("vehicles", "at", "rounds"), compared, claims),
    }


COLOURS = (style.INK, style.BLUE, style.ORANGE)


class Reached(Protocol):
    """Accuracy of a federation before the first and after each round, with the cumulated uplink [MB]."""

    @property
    def up_mb(self) -> Sequence[float]:
        """The megabytes, ascending."""
        ...

    @property
    def accuracy(self) -> Sequence[float]:
        """The accuracies."""
        ...


@style.styled
def draw_by_megabytes(found: Mapping[str, Mapping[str, Mapping[str, Reached]]], names: Sequence[str]) -> Figure:
    """Return the accuracy by uplink, a panel per setting: the mean over seeds, and a band from least to greatest.

    `found` is by setting, seed and name. Between rounds an accuracy is interpolated; a line ends where the first of its
    seeds does.
    """
    figure = style.canvas(7.6, 3.6)
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for panel, (setting, seeds) in zip(panels, found.items(), strict=True):
        for name, colour in zip(names, COLOURS, strict=False):
            reached = [by_name[name] for by_name in seeds.values()]
            mb = np.linspace(0.0, min(each.up_mb[-1] for each in reached), POINTS)
            accuracy = np.array([np.interp(mb, each.up_mb, each.accuracy) for each in reached])
            panel.fill_between(mb, accuracy.min(axis=0), accuracy.max(axis=0), color=colour, alpha=0.2, linewidth=0)
            panel.plot(mb, accuracy.mean(axis=0), color=colour, linewidth=1.8, label=name)
            panel.plot(mb[-1], accuracy.mean(axis=0)[-1], "o", color=colour, markersize=4)
        panel.set(xlabel="uplink of the vehicles [MB]", title=f"{setting}, {len(seeds)} seeds")
        panel.grid(axis="y")
    panels[0].set(ylabel="accuracy: mean, least to greatest")
    style.key(figure, panels[0].get_legend_handles_labels()[0], ncols=3)
    return figure


POINTS = 200  # of a line


def _run(out: Path, options: Options) -> Outcome[GroupsResult]:
    with options.show_progress(options.title) as report:
        results, pictures = compare_groups(out, options.seeds, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(GroupsResult, _run, groups_tables, seeds=10, takes=("seeds",))
