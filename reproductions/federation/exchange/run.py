"""Comparison of exchanges in federated learning, by arms of a recipe: accuracy, bytes, seconds and epsilon.

The recipes are recipes/runs/exchange.yaml, for the weather task, and exchange_objects.yaml, with some of its arms.

All arms of a seed have the same recordings, the same stage I and the same rounds. They differ in the form of the
updates, client selection, personalisation of regions, or privacy. The first arm sends whole weights (FedAvg). All
others are compared with it, paired over seeds, which have different recordings; the verdicts are corrected together.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.federation.state import RoundDivergence
from flcav.network.clock.records import ClientWork, work_of_messages
from flcav.network.clock.rounds import NetworkSettings, RoundRules, time_round
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.network.radio.links import RadioLinks
from flcav.report import style
from flcav.report.charts.runs import name_measure
from flcav.report.cloud_rounds import format_divergence, span_divergence
from flcav.runs.arms import name_steps
from flcav.runs.driving import link_scenes
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import Run
from flcav.runs.running import WORK
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED, Judged, judge_means
from flcav.storage.markdown import format_table
from flcav.storage.records import LEFT_OUT, Record

NONE, NO_CLOUD, WHOLE = "no federation", "no cloud round", "whole weights (FedAvg)"
ARMS: Mapping[str, Mapping[str, str]] = {  # by topic: name in the tables -> arm
    "compared with": {NONE: PRETRAIN, WHOLE: MAIN},
    "what the cloud does": {NO_CLOUD: EDGE, "learning rate begun anew": "restarted"},
    "what is sent": {
        "fp16": "fp16",
        "int8": "int8",
        "top 2 %, error feedback": "top_k",
        "fully connected layers": "layers",
        "outputs (FedMD)": "outputs",
    },
    "who takes part": {
        "uniform, 2": "uniform",
        "importance, 2": "importance",
        "all that the radio allows": "radio",
        "in time for a deadline": "deadline",
    },
    "what regions keep": {
        "output layer (FedPer)": "heads",
        "normalisation (FedBN)": "norms",
        "statistics (SiloBN)": "statistics",
        "models (Ditto)": "regional",
    },
    "what stays private": {
        "secure aggregation": "masked",
        "central noise, 1": "central",
        "central noise, 0.03": "central_faint",
        "local noise, 1": "local",
        "local noise, 0.03": "local_faint",
    },
}
NAMES: Mapping[str, str] = {name: arm for arms in ARMS.values() for name, arm in arms.items()}
OWN, OTHERS, UNSEEN = "own region", "other regions", "unseen region"
PLACES = (OWN, OTHERS, UNSEEN)


@dataclass(frozen=True)
class ExchangeArm:
    """Results of one arm in one seed; megabytes are those of stages II and III, 1 MB = 10^6 bytes."""

    accuracy: Mapping[str, float]  # the task's measure by tested place of `PLACES`
    wireless_up_mb: float
    wireless_down_mb: float
    wireline_up_mb: float
    wireline_down_mb: float
    clients: float  # mean number of updates combined in a round of vehicles
    seconds: float | None  # mean duration of a round over the radio; None: nothing is sent or arrives
    epsilon: float | None  # of a vehicle's whole data after all rounds; None without noise


@dataclass(frozen=True)
class ExchangeResult(Record):
    """Results of the comparison: numbers by seed and arm, means over seeds, differences to whole weights."""

    seeds: Mapping[str, Mapping[str, ExchangeArm]]  # by seed and arm
    accuracy: Mapping[str, Mapping[str, MeanOverSeeds]]  # by arm and place
    differences: Mapping[str, Mapping[str, MeanOverSeeds]]  # to whole weights, by arm and place
    recipe: Mapping[str, Json]
    provenance: Provenance
    divergence: Annotated[Mapping[str, RoundDivergence] | None, LEFT_OUT] = None  # by seed, of whole weights

    @property
    def measure(self) -> str:
        """Return the name of the task's measure."""
        tasks = (self.recipe or {}).get("tasks")
        return "AP50" if isinstance(tasks, Mapping) and "objects" in tasks else "accuracy"

    @property
    def places(self) -> tuple[str, ...]:
        """Return the tested places, in the order of `PLACES`."""
        return tuple(place for place in PLACES if place in self.accuracy[WHOLE])

    @property
    def groups(self) -> Mapping[str, tuple[str, ...]]:
        """Return the names of the compared arms by topic."""
        present = {group: tuple(name for name in arms if name in self.accuracy) for group, arms in ARMS.items()}
        return {group: names for group, names in present.items() if names}

    def sentences(self) -> list[str]:
        """Return accuracy, uplink and the verdict on the difference to whole weights of each arm, in words."""
        judged = judge_differences(self)
        sentences = []
        for name in self.accuracy:
            mean = self.accuracy[name][OWN]
            sent = float(np.mean([seed[name].wireless_up_mb for seed in self.seeds.values()]))
            words = f"{name}: {self.measure} in the own region {mean.describe()}, wireless uplink {sent:.2f} MB"
            if name in judged:
                difference = self.differences[name][OWN].describe(sign=True)
                words += f", difference {difference}, {judged[name].describe()}"
            sentences.append(words)
        return sentences


def compare_exchanges(recipe: RunRecipe, runs: Sequence[Run], folders: Sequence[Path]) -> ExchangeResult:
    """Return the results of the arms of `recipe`, from a run of each seed in its folder.

    `folders` hold the runs' steps and the arms' ledgers.
    """
    seeds = {str(run.recipe.seed): measure_seed(run, folder) for run, folder in zip(runs, folders, strict=True)}
    stages = {str(run.recipe.seed): run.arms[MAIN].stages for run in runs}
    rounds = {seed: [round_ for stage in run for round_ in stage.records or ()] for seed, run in stages.items()}
    divergence = {seed: span for seed, of_seed in rounds.items() if (span := span_divergence(of_seed)) is not None}
    return replace(summarise(recipe, seeds), divergence=divergence or None)


def summarise(recipe: RunRecipe, seeds: Mapping[str, Mapping[str, ExchangeArm]]) -> ExchangeResult:
    """Return the means over seeds, with 95 % intervals."""

    def values(name: str, place: str) -> list[float]:
        return [seed[name].accuracy[place] for seed in seeds.values()]

    def differences(name: str, place: str) -> list[float]:
        """Return the paired differences, rounded so that equal counts of correct answers differ by exactly 0."""
        pairs = zip(values(name, place), values(WHOLE, place), strict=True)
        return [round(value - whole, 9) for value, whole in pairs]

    arms = next(iter(seeds.values()))
    return ExchangeResult(
        seeds=seeds,
        accuracy={
            name: {place: mean_over_seeds(values(name, place), share=True) for place in arm.accuracy}
            for name, arm in arms.items()
        },
        differences={
            name: {place: mean_over_seeds(differences(name, place)) for place in arm.accuracy if place != OTHERS}
            for name, arm in arms.items()
            if name != WHOLE
        },
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def measure_seed(run: Run, folder: Path) -> dict[str, ExchangeArm]:
    """Return the results of all arms in one seed's run."""
    (task,) = run.recipe.tasks
    plan = run.arms[MAIN].plan.tasks[task]
    rounds = plan.edge_rounds + plan.cloud_rounds * run.recipe.federation.edge_rounds_per_cloud_round
    links = link_regions(run.recipe, task, folder / WORK, rounds)
    found = {NONE: ExchangeArm(measure_places(run, MAIN, PRETRAIN), 0.0, 0.0, 0.0, 0.0, 0.0, None, None)}
    for name, arm in NAMES.items():
        arm, stages = (MAIN, (EDGE,)) if name == NO_CLOUD else (arm, (EDGE, CLOUD))
        if name == NONE or arm not in run.arms:
            continue
        whole = Ledger.load(folder / "ledgers" / f"{arm}.parquet")
        book = Ledger(whole.budget, [entry for entry in whole.entries if entry.stage in stages])
        kept = [stage for stage in run.arms[arm].stages if stage.stage in stages]
        records = [record for stage in kept for record in stage.records or ()]
        spent = [record.epsilon for record in records if record.epsilon is not None]
        found[name] = ExchangeArm(
            accuracy=measure_places(run, arm, stages[-1]),
            wireless_up_mb=book.used_mb("wireless", direction="up"),
            wireless_down_mb=book.used_mb("wireless", direction="down"),
            wireline_up_mb=book.used_mb("wireline", direction="up"),
            wireline_down_mb=book.used_mb("wireline", direction="down"),
            clients=float(np.mean([len(record.clients) for record in records if record.server != CLOUD])),
            seconds=mean_round_s(book.entries, links, plan.edge_rounds),
            epsilon=max(spent) if spent else None,
        )
    return found


def measure_places(run: Run, arm: str, stage: str) -> dict[str, float]:
    """Return the accuracy of the federating regions' networks after a stage, by place.

    It is the task's measure of the regional model, if there is one, or else of the common model. In `OWN` networks are
    tested in their region; `OTHERS` averages over the regions of pretraining and the other federating ones; `UNSEEN` is
    the common model's, if there is an unseen region. After stage II networks are only tested in their region.
    """
    (task,), home, unseen = run.recipe.tasks, run.recipe.with_role("federate"), run.recipe.with_role("unseen")
    known = [name for name in run.recipe.regions if name not in unseen]
    kept = {
        (test.model, test.region): test.estimate.mean
        for test in (run.arms[arm].regional or () if stage == CLOUD else ())
    }

    def accuracy(model: str, region: str) -> float:
        regional = kept.get((model, region))
        return run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean if regional is None else regional

    if stage == EDGE:
        return {OWN: float(np.mean([accuracy(region, region) for region in home]))}
    of_all = [run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean for region in unseen]
    return {
        OWN: float(np.mean([accuracy(region, region) for region in home])),
        OTHERS: float(np.mean([accuracy(model, region) for model in home for region in known if region != model])),
    } | ({UNSEEN: float(np.mean(of_all))} if of_all else {})


def judge_differences(results: ExchangeResult) -> dict[str, Judged]:
    """Return the verdicts on the differences in the own region, corrected together."""
    return judge_means({name: places[OWN] for name, places in results.differences.items()})


def draw_results(results: ExchangeResult) -> bytes:
    """Return the figure of accuracies and wireless uplink as a PNG."""

    def sent(name: str) -> float:
        return float(np.mean([seed[name].wireless_up_mb for seed in results.seeds.values()]))

    marks = [
        Mark(group, name, sent(name), results.accuracy[name][OWN], results.accuracy[name].get(UNSEEN))
        for group, names in results.groups.items()
        for name in names
    ]
    return style.png(draw_exchanges(marks, results.measure))


def link_regions(recipe: RunRecipe, task: str, work: Path, rounds: int) -> dict[str, list[RadioLinks]]:
    """Return the radio links in the scenes of the first `rounds` rounds, by federating region.

    `work` is the folder of the run's steps. Raises `InputError` as `link_scenes`.
    """
    names = name_steps(recipe)
    links = {}
    for region in recipe.with_role("federate"):
        split = Frames.open(work / names.recording(region, EDGE, task))
        placed = Placed.load(work / names.place(MAIN, region))
        links[region] = link_scenes(split, placed, NetworkSettings(), rounds, recipe.seed)
    return links


def mean_round_s(
    entries: Iterable[LedgerEntry], links: Mapping[str, Sequence[RadioLinks]], edge_rounds: int
) -> float | None:
    """Return the mean duration [s] of the rounds of stages II and III in all regions; None where no update arrives.

    A round lasts until the last message of its vehicles has arrived; vehicles lost by the radio do not count. The
    scenes of stage III follow those of the `edge_rounds` rounds of stage II.
    """
    rounds: dict[tuple[str, str, int], list[LedgerEntry]] = {}
    for entry in entries:
        if entry.link == "wireless" and entry.stage in (EDGE, CLOUD) and entry.round > 0:
            region = entry.client.partition("/")[0]
            rounds.setdefault((region, entry.stage, entry.round), []).append(entry)
    lasted = []
    for (region, stage, number), sent in rounds.items():
        vehicles = {entry.client.rpartition("/")[2] for entry in sent}
        scenes = links[region]
        driven = number + (edge_rounds if stage == CLOUD else 0)
        works = work_of_messages(sent, dict.fromkeys(vehicles, 0.0))
        ends = _time_round(scenes[(driven - 1) % len(scenes)], works, driven)
        lasted += [] if ends is None else [ends]
    return float(np.mean(lasted)) if lasted else None


def _time_round(links: RadioLinks, works: Mapping[str, ClientWork], number: int) -> float | None:
    present = dict(zip(links.vehicle, links.present[0].tolist(), strict=True))
    there = [work for name, work in works.items() if present.get(name)]
    if not there:
        return None
    start = float(links.time_s[0])
    timings = time_round(links, there, number, start, RoundRules())
    return max((timing.end_s - start for timing in timings if not timing.dropped), default=None)


WORDS = {HELD: "higher", NOT_HELD: "lower", UNDECIDED: UNDECIDED}  # of the claim that a difference is positive


def tables(results: ExchangeResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, costs, differences, cloud; the last is empty where it was not measured."""
    return {
        "accuracy": _accuracy(results),
        "costs": _costs(results),
        "differences": _differences(results),
        "cloud": _cloud(results),
    }


def _accuracy(results: ExchangeResult) -> str:
    def describe(name: str, place: str) -> str:
        return results.accuracy[name][place].describe() if place in results.accuracy[name] else ""

    rows = [
        [group, name, *(describe(name, place) for place in results.places)]
        for group, names in results.groups.items()
        for name in names
    ]
    measured = (f"{results.measure}, {place}" for place in results.places)
    return format_table(("", f"arm, {len(results.seeds)} seeds", *measured), rows)


def _costs(results: ExchangeResult) -> str:
    def mean(name: str, number: Callable[[ExchangeArm], float | None], digits: int) -> str:
        known = [value for seed in results.seeds.values() if (value := number(seed[name])) is not None]
        return f"{np.mean(known):.{digits}f}" if known else ""

    numbers: tuple[tuple[Callable[[ExchangeArm], float | None], int], ...] = (
        (lambda arm: arm.wireless_up_mb, 3),
        (lambda arm: arm.wireless_down_mb, 2),
        (lambda arm: arm.wireline_up_mb, 3),
        (lambda arm: arm.wireline_down_mb, 2),
        (lambda arm: arm.clients, 1),
        (lambda arm: arm.seconds, 2),
    )
    rows = []
    for names in results.groups.values():
        for name in names:
            if name != NONE:
                private = next(iter(results.seeds.values()))[name].epsilon  # the same in all seeds
                epsilon = "∞" if private is None else f"{float(f'{private:.3g}'):,g}"
                rows.append([name, *(mean(name, number, digits) for number, digits in numbers), epsilon])
    links = (f"{link} {way}, MB" for link in ("wireless", "wireline") for way in ("up", "down"))
    return format_table(("arm", *links, "vehicles in a round of a region", "s a round", "ε"), rows)


def _differences(results: ExchangeResult) -> str:
    judged = judge_differences(results)
    rows = []
    for name in (arm for names in results.groups.values() for arm in names if arm in results.differences):
        one, places = judged[name], results.differences[name]
        shown = [place for place in (OWN, UNSEEN) if place in results.places]
        cells = [places[place].describe(sign=True) if place in places else "" for place in shown]
        rows.append([name, cells[0], one.p_cell, WORDS[one.verdict], one.takes_cell, *cells[1:]])
    header = (
        "arm",
        f"{results.measure} - that of whole weights, {OWN}",
        "p, corrected",
        "verdict",
        "if undecided: seeds that detect a difference of the observed size",
        *([f"the same, {UNSEEN}"] if UNSEEN in results.places else []),
    )
    return format_table(header, rows)


def _cloud(results: ExchangeResult) -> str:
    """Return the divergence of the regions in each seed, and the gain of cloud rounds in the own region."""
    if not results.divergence:
        return ""
    seeds = {seed: results.seeds[seed] for seed in results.divergence}
    gain = [arms[WHOLE].accuracy[OWN] - arms[NO_CLOUD].accuracy[OWN] for arms in seeds.values()]
    names = [f"seed {seed}" for seed in seeds]
    return format_divergence(names, [*results.divergence.values()], {f"{OWN}: cloud - edge FL": gain})


COLOURS = (
    style.INK,
    style.BLUE,
    style.ORANGE,
    style.GREEN,
    style.VERMILLION,
    style.PURPLE,
)  # in the order of the groups
ROW, GAP = 0.235, 0.6  # height of a row [inch], and between two groups [rows]


@dataclass(frozen=True)
class Mark:
    """Values of an arm in the figure: wireless uplink, and accuracy in the own and in the unseen region."""

    group: str
    name: str
    up_mb: float  # 0: nothing is sent
    own: MeanOverSeeds
    unseen: MeanOverSeeds | None  # None without an unseen region


@style.styled
def draw_exchanges(marks: Sequence[Mark], measure: str) -> Figure:
    """Return a figure with a row per arm: its `measure` with 95 % intervals over seeds, and uplink on a log axis.

    A line marks the accuracy of the first arm that sends something, with which the others are compared.
    """
    groups = list(dict.fromkeys(mark.group for mark in marks))
    rows = [place + GAP * groups.index(mark.group) for place, mark in enumerate(marks)]
    figure = style.canvas(8.6, ROW * (rows[-1] + 1) + 0.9)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(5, 3))
    first = next(mark for mark in marks if mark.up_mb > 0)
    left.axvline(first.own.mean, color=style.MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    for row, mark in zip(rows, marks, strict=True):
        colour = COLOURS[groups.index(mark.group) % len(COLOURS)]
        _draw_interval(left, row - 0.13, mark.own, colour, filled=True)
        if mark.unseen is not None:
            _draw_interval(left, row + 0.17, mark.unseen, colour, filled=False)
        if mark.up_mb > 0:
            right.plot(mark.up_mb, row, "o", color=colour, markersize=5)
            right.annotate(
                f"{mark.up_mb:.2g}" if mark.up_mb < 10 else f"{mark.up_mb:.0f}",
                (mark.up_mb, row),
                (6, 0),
                textcoords="offset points",
                va="center",
                fontsize=style.SMALL,
                color=style.MUTED,
            )
    left.set_yticks(rows, [mark.name for mark in marks])
    for label, mark in zip(left.get_yticklabels(), marks, strict=True):
        label.set_color(COLOURS[groups.index(mark.group) % len(COLOURS)])
    left.set_ylim(rows[-1] + 0.7, -0.7)
    shown = "own region ●" + (", unseen region ○" if any(mark.unseen for mark in marks) else "")
    left.set_xlabel(f"{name_measure(measure, [mark.own for mark in marks])}:\n{shown}")
    sent = [mark.up_mb for mark in marks if mark.up_mb > 0]
    right.set(xscale="log", xlabel="wireless uplink, stages II and III [MB]", xlim=(min(sent) / 1.6, max(sent) * 3))
    right.xaxis.set_major_formatter(FuncFormatter(lambda mb, _: f"{mb:g}"))
    right.xaxis.set_minor_formatter(NullFormatter())
    for axes in (left, right):
        axes.grid(axis="x")
        axes.spines["left"].set_visible(False)
    return figure


def _draw_interval(axes: Axes, row: float, mean: MeanOverSeeds, colour: str, filled: bool) -> None:
    if mean.low is not None and mean.high is not None:
        axes.plot([mean.low, mean.high], [row, row], color=colour, linewidth=1.2 if filled else 0.7)
    axes.plot(mean.mean, row, "o", color=colour, markersize=4.5, markerfacecolor=colour if filled else "white")


def run_exchange(name: str, out: Path, options: Options) -> Outcome[ExchangeResult]:
    """Run or resume the comparison of the recipe `runs/NAME`."""
    recipe = options.load(name, shrink_recipe)
    runs = options.run_seeds(recipe, out)
    results = compare_exchanges(recipe, runs, [out / f"seed{run.recipe.seed}" for run in runs])
    return Outcome(results, {"exchange.png": draw_results(results)}, results.sentences())


EXPERIMENT = Experiment(ExchangeResult, partial(run_exchange, "exchange"), tables, seeds=8, recipe="exchange")
