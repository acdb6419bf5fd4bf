"""Comparison of exchanges, the arms of a recipe: accuracy, bytes, seconds and epsilon of each.

The recipes are recipes/runs/exchange.yaml, of the weather, and exchange_objects.yaml, which has some of its arms.

All arms of a seed have the same recordings, the same stage I and the same rounds. They differ in the form of the
updates, in who takes part, in what regions keep for themselves, or in what stays private. The first arm sends whole
weights (FedAvg). Every other one is compared with it, paired over seeds, which have recordings of their own; the
verdicts are corrected together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from flcav.config import Json
from flcav.experiments.cloud_rounds import span_divergence
from flcav.experiments.exchanges.clock import link_regions, mean_round_s
from flcav.federation.divergence import RoundDivergence
from flcav.network.ledger import Ledger
from flcav.report import style
from flcav.report.charts.federation.exchanges import Mark, draw_exchanges
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.running import WORK
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import Judged, judge_means
from flcav.storage.records import LEFT_OUT, Record

NONE, NO_CLOUD, WHOLE = "no federation", "no cloud round", "whole weights (FedAvg)"
ARMS: Mapping[str, Mapping[str, str]] = {  # by what they are about: name in the tables -> arm
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

    accuracy: Mapping[str, float]  # the task's measure by those of `PLACES` that its networks were tested in
    wireless_up_mb: float
    wireless_down_mb: float
    wireline_up_mb: float
    wireline_down_mb: float
    clients: float  # whose updates are combined in a round of vehicles, mean
    seconds: float | None  # of a round on the radio, mean; None: nothing is sent, or no vehicle gets through
    epsilon: float | None  # of a vehicle's whole data after all rounds; None: without noise


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
        """Return those of `PLACES` that networks were tested in."""
        return tuple(place for place in PLACES if place in self.accuracy[WHOLE])

    @property
    def groups(self) -> Mapping[str, tuple[str, ...]]:
        """Return the names of the compared arms by what they are about."""
        found = {group: tuple(name for name in arms if name in self.accuracy) for group, arms in ARMS.items()}
        return {group: names for group, names in found.items() if names}

    def sentences(self) -> list[str]:
        """Return accuracy, uplink and the verdict on the difference to whole weights of each arm, in words."""
        judged, told = judge_differences(self), []
        for name in self.accuracy:
            mean = self.accuracy[name][OWN]
            sent = float(np.mean([seed[name].wireless_up_mb for seed in self.seeds.values()]))
            words = f"{name}: {self.measure} in the own region {mean.describe()}, wireless uplink {sent:.2f} MB"
            if name in judged:
                found = self.differences[name][OWN].describe(sign=True)
                words += f", difference {found}, {judged[name].describe()}"
            told.append(words)
        return told


def compare_exchanges(recipe: RunRecipe, runs: Sequence[Run], folders: Sequence[Path]) -> ExchangeResult:
    """Return the results of the arms of `recipe`, from a run of each seed in its folder.

    `folders` hold the runs' steps and the arms' ledgers.
    """
    seeds = {str(run.recipe.seed): measure_seed(run, folder) for run, folder in zip(runs, folders, strict=True)}
    stages = {str(run.recipe.seed): run.arms[MAIN].stages for run in runs}
    rounds = {seed: [each for stage in own for each in stage.records or ()] for seed, own in stages.items()}
    divergence = {seed: found for seed, own in rounds.items() if (found := span_divergence(own)) is not None}
    return replace(summarise(recipe, seeds), divergence=divergence or None)


def summarise(recipe: RunRecipe, seeds: Mapping[str, Mapping[str, ExchangeArm]]) -> ExchangeResult:
    """Return the means over seeds, with 95 % intervals."""

    def values(name: str, place: str) -> list[float]:
        return [seed[name].accuracy[place] for seed in seeds.values()]

    def differences(name: str, place: str) -> list[float]:
        """Return the paired differences, rounded so that equal counts of right answers differ by 0."""
        pairs = zip(values(name, place), values(WHOLE, place), strict=True)
        return [round(own - whole, 9) for own, whole in pairs]

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
    """Return the numbers of every arm of one seed's run."""
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
        records = [each for stage in kept for each in stage.records or ()]
        spent = [each.epsilon for each in records if each.epsilon is not None]
        found[name] = ExchangeArm(
            accuracy=measure_places(run, arm, stages[-1]),
            wireless_up_mb=book.used_mb("wireless", direction="up"),
            wireless_down_mb=book.used_mb("wireless", direction="down"),
            wireline_up_mb=book.used_mb("wireline", direction="up"),
            wireline_down_mb=book.used_mb("wireline", direction="down"),
            clients=float(np.mean([len(each.clients) for each in records if each.server != CLOUD])),
            seconds=mean_round_s(book.entries, links, plan.edge_rounds),
            epsilon=max(spent) if spent else None,
        )
    return found


def measure_places(run: Run, arm: str, stage: str) -> dict[str, float]:
    """Return the accuracy of what each federating region has after a stage: at home, in others, in the unseen one.

    It is by the task's measure, of the region's own model where it keeps one, and else of the model for all. Others are
    the regions of pretraining and the other federating ones, averaged over both. In the unseen region, where there is
    one, it is the model for all. After stage II each region's network is tested at home alone.
    """
    (task,), home, unseen = run.recipe.tasks, run.recipe.with_role("federate"), run.recipe.with_role("unseen")
    known = [name for name in run.recipe.regions if name not in unseen]
    kept = {
        (each.model, each.region): each.estimate.mean
        for each in (run.arms[arm].regional or () if stage == CLOUD else ())
    }

    def accuracy(model: str, region: str) -> float:
        own = kept.get((model, region))
        return run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean if own is None else own

    if stage == EDGE:
        return {OWN: float(np.mean([accuracy(region, region) for region in home]))}
    of_all = [run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean for region in unseen]
    return {
        OWN: float(np.mean([accuracy(region, region) for region in home])),
        OTHERS: float(np.mean([accuracy(model, region) for model in home for region in known if region != model])),
    } | ({UNSEEN: float(np.mean(of_all))} if of_all else {})


def judge_differences(results: ExchangeResult) -> dict[str, Judged]:
    """Return the verdicts on the differences in the own region, corrected together."""
    return judge_means({name: each[OWN] for name, each in results.differences.items()})


def draw_results(results: ExchangeResult) -> bytes:
    """Return the figure of accuracy beside the bytes of the wireless uplink as a PNG."""

    def sent(name: str) -> float:
        return float(np.mean([seed[name].wireless_up_mb for seed in results.seeds.values()]))

    marks = [
        Mark(group, name, sent(name), results.accuracy[name][OWN], results.accuracy[name].get(UNSEEN))
        for group, names in results.groups.items()
        for name in names
    ]
    return style.png(draw_exchanges(marks, results.measure))
