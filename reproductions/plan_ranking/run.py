"""Predicted against realised accuracy of plans that are trained apart: how the learning curve of MLGRA ranks them.

Each plan is a run of its own, from its samples to its last cloud round (recipes/runs/plan_ranking.yaml); runs of a seed
share pool, registry and test frames, and those of as many samples end pretraining with the same network. The curve is
that of the history `tracks`, which is of other seeds and has the rounds of one long run as its points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.held_out import rank_correlation
from flcav.optimization.curves.history import History
from flcav.report import style
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN, FixedPlan, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.running import run_several
from flcav.runs.tables import parse_history, read_history
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import describe_means, judge_means
from flcav.storage.markdown import format_signed, format_table
from flcav.storage.records import Record

TASK, HISTORY, WIRELESS = "objects", "tracks", "wireless"
STAGES = (PRETRAIN, EDGE, CLOUD)
SAMPLES, ROUNDS = (40, 80, 160), ((1, 4), (3, 1), (6, 4), (10, 1))  # rounds: of edge and cloud FL
ALIKE = 1.3  # plans are rivals where one costs at most so many times the wireless megabytes of the other
APART = 0.002  # in predicted AP50, by which the picture parts plans of other samples
COLOURS = (style.BLUE, style.ORANGE, style.GREEN)  # by samples
RANKED, RIGHT = "rank correlation of all plans", "pairs of rivals in the right order, less half"

Counts = tuple[int, int, int]  # samples, edge rounds, cloud rounds
PLANS: tuple[Counts, ...] = tuple((samples, *rounds) for samples, rounds in product(SAMPLES, ROUNDS))
TOY: tuple[Counts, ...] = ((8, 1, 1), (8, 2, 1), (16, 1, 1))  # of a trial


@dataclass(frozen=True)
class TrainedPlan:
    """A plan in one seed: its wireless megabytes and the AP50 it reached, by stage and town."""

    counts: Counts
    wireless_mb: float
    ap50: Mapping[str, Mapping[str, float]]

    def reached(self, stage: str = CLOUD) -> float:
        """Return AP50 after a stage, in the mean of the towns."""
        return float(np.mean([*self.ap50[stage].values()]))


@dataclass(frozen=True)
class ComparedPlan:
    """A plan, the AP50 that the curve predicts for it after edge and cloud FL, and what it reached over seeds."""

    counts: Counts
    wireless_mb: float  # in the mean of seeds
    predicted: Mapping[str, float]  # by stage
    reached: Mapping[str, MeanOverSeeds]


@dataclass(frozen=True)
class PlanRanking(Record):
    """Predicted and realised AP50 of plans, and how well their orders agree."""

    plans: tuple[ComparedPlan, ...]
    rivals: tuple[tuple[int, int], ...]  # pairs of numbers of plans that cost alike
    claims: Mapping[str, MeanOverSeeds]
    after_edge: MeanOverSeeds  # rank correlation before cloud FL
    gain_error: MeanOverSeeds  # mean error of a plan's predicted AP50, less the mean error of all plans of the seed
    of_means: float  # rank correlation of the predictions with the means over seeds
    seeds: Mapping[str, tuple[TrainedPlan, ...]]
    recipe: Mapping[str, Json]  # without its seed
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the claims in words."""
        return [*describe_means(self.claims), f"rank correlation of means over seeds: {self.of_means:+.3f}"]


def list_recipes(recipe: RunRecipe, plans: Sequence[Counts], seeds: Sequence[int]) -> dict[str, RunRecipe]:
    """Return the recipe of each seed's run of each plan, by the name of its folder."""

    def fix(seed: int, counts: Counts) -> RunRecipe:
        samples, edge_rounds, cloud_rounds = counts
        plan = FixedPlan(samples=samples, edge_rounds=edge_rounds, cloud_rounds=cloud_rounds)
        task = recipe.tasks[TASK].model_copy(update={"plan": plan})
        return recipe.model_copy(update={"seed": seed, "tasks": {TASK: task}})

    return {f"seed{seed}-{'-'.join(map(str, plan))}": fix(seed, plan) for seed in seeds for plan in plans}


def read_plan(run: Run) -> TrainedPlan:
    """Return the plan of a run and what it reached."""
    plan, arm = run.recipe.tasks[TASK].plan, run.arms["main"]
    assert plan is not None  # `list_recipes` gives one
    towns = run.recipe.with_role("federate")
    ap50 = {
        stage: {town: run.test(stage=stage, region=town, task=TASK).estimate.mean for town in towns} for stage in STAGES
    }
    return TrainedPlan((plan.samples, plan.edge_rounds, plan.cloud_rounds), arm.links[WIRELESS].used_mb, ap50)


def collect_history(seeds: Mapping[str, Sequence[TrainedPlan]], towns: Sequence[str]) -> History:
    """Return what plans reached after each of their stages in the mean of towns, as the history of a learning curve.

    Plans of a seed that have as many samples begin with the same pretrained network, which is one point.
    """
    points = {
        (seed, spent, float(np.mean([plan.ap50[stage][town] for town in towns])))
        for seed, plans in seeds.items()
        for plan in plans
        for samples, edge, cloud in [plan.counts]
        for stage, spent in zip(STAGES, ((samples, 0, 0), (samples, edge, 0), (samples, edge, cloud)), strict=True)
    }
    names, spent, accuracy = zip(*sorted(points), strict=True)
    return History(np.array(spent, float), np.array(accuracy), np.ones(len(points)), seeds=names)


def predict(plans: Sequence[Counts]) -> dict[str, Array]:
    """Return the AP50 (n,) that the history's curve predicts for plans, after edge and after cloud FL."""
    curve = fit(parse_history(TASK, read_history(TASK, HISTORY, Path()), HISTORY), model="best").curve
    spent = {EDGE: [(samples, edge, 0) for samples, edge, _ in plans], CLOUD: plans}
    return {
        stage: np.array([1 - float(curve.error(samples, edge, cloud, 1)) for samples, edge, cloud in counts])
        for stage, counts in spent.items()
    }


def list_rivals(wireless_mb: Sequence[float]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of plans, by their numbers, that cost alike (`ALIKE`)."""
    pairs = combinations(range(len(wireless_mb)), 2)
    return tuple(pair for pair in pairs if max(costs := [wireless_mb[one] for one in pair]) <= ALIKE * min(costs))


def order_rightly(predicted: Array, reached: Array, pairs: Sequence[tuple[int, int]]) -> float:
    """Return the share of pairs of plans that two rows (n,) of accuracies order alike."""
    one, other = np.array(pairs).T
    return float(np.mean((predicted[one] - predicted[other]) * (reached[one] - reached[other]) > 0))


def rank_plans(
    seeds: Mapping[str, Sequence[TrainedPlan]], predicted: Mapping[str, Array], settings: Mapping[str, Json]
) -> PlanRanking:
    """Return how the predictions of `predict` agree with what the plans reached; all seeds have the same plans."""
    plans = next(iter(seeds.values()))
    costs = [float(np.mean([own[number].wireless_mb for own in seeds.values()])) for number in range(len(plans))]
    rivals = list_rivals(costs)
    reached = {
        stage: np.array([[plan.reached(stage) for plan in own] for own in seeds.values()]) for stage in (EDGE, CLOUD)
    }
    off = [row - predicted[CLOUD] for row in reached[CLOUD]]

    def correlate(stage: str) -> MeanOverSeeds:
        return mean_over_seeds([rank_correlation(predicted[stage], row) for row in reached[stage]])

    return PlanRanking(
        tuple(
            ComparedPlan(
                plan.counts,
                costs[number],
                {stage: float(values[number]) for stage, values in predicted.items()},
                {stage: mean_over_seeds(rows[:, number].tolist()) for stage, rows in reached.items()},
            )
            for number, plan in enumerate(plans)
        ),
        rivals,
        {
            RANKED: correlate(CLOUD),
            RIGHT: mean_over_seeds([order_rightly(predicted[CLOUD], row, rivals) - 0.5 for row in reached[CLOUD]]),
        },
        correlate(EDGE),
        mean_over_seeds([float(np.abs(row - row.mean()).mean()) for row in off]),
        rank_correlation(predicted[CLOUD], reached[CLOUD].mean(axis=0)),
        {name: tuple(own) for name, own in seeds.items()},
        settings,
        provenance(),
    )


def tabulate_ranking(results: PlanRanking) -> dict[str, str]:
    """Return Markdown by name: claims, plans, errors."""
    return {
        "claims": format_table(
            ("claim: above 0", "mean over seeds", "p, corrected", "verdict", "if undecided: seeds"),
            [
                [name, results.claims[name].describe(sign=True), one.p_cell, one.verdict, one.takes_cell]
                for name, one in judge_means(results.claims).items()
            ],
        ),
        "plans": format_table(
            (
                *("samples / edge / cloud", "wireless MB", "after edge FL, predicted", "trained"),
                *("after cloud FL, predicted", "trained", "trained - predicted"),
            ),
            [
                [
                    "/".join(map(str, plan.counts)),
                    f"{plan.wireless_mb:.0f}",
                    *(
                        cell
                        for stage in (EDGE, CLOUD)
                        for cell in (f"{plan.predicted[stage]:.3f}", plan.reached[stage].describe())
                    ),
                    format_signed(plan.reached[CLOUD].mean - plan.predicted[CLOUD]),
                ]
                for plan in results.plans
            ],
        ),
        "errors": format_table(
            ("rank correlation after edge FL", "of means over seeds, after cloud FL", "mean error of a plan's AP50"),
            [
                [
                    results.after_edge.describe(sign=True),
                    format_signed(results.of_means),
                    results.gain_error.describe(),
                ]
            ],
        ),
    }


@style.styled
def draw_ranking(results: PlanRanking) -> bytes:
    """Return trained against predicted AP50 after cloud FL as a PNG: means over seeds, a colour by samples.

    What seeds differ by on all plans is taken from their rows, so that intervals tell plans of the same seeds apart.
    """
    reached = np.array([[plan.reached() for plan in own] for own in results.seeds.values()])
    level = reached - reached.mean(axis=1, keepdims=True) + reached.mean()
    figure = style.canvas(6.4, 4.4)
    axes = figure.add_subplot()
    samples = sorted({plan.counts[0] for plan in results.plans})
    for plan, rows in zip(results.plans, level.T, strict=True):
        count, edge, cloud = plan.counts
        number = samples.index(count)
        at, mean = plan.predicted[CLOUD] + APART * (number - (len(samples) - 1) / 2), mean_over_seeds(rows.tolist())
        if mean.low is not None and mean.high is not None:
            axes.plot([at, at], [mean.low, mean.high], color=COLOURS[number], linewidth=1.5, alpha=0.5)
        axes.plot(at, mean.mean, "o", color=COLOURS[number], markersize=6, label=f"{count} samples")
        left = number == 1
        axes.annotate(
            f"{edge}/{cloud}",
            (at, mean.mean),
            (-7 if left else 7, 0),
            textcoords="offset points",
            va="center",
            ha="right" if left else "left",
            fontsize=style.SMALL,
            color=COLOURS[number],
        )
    ends = [min(plan.predicted[CLOUD] for plan in results.plans), max(plan.predicted[CLOUD] for plan in results.plans)]
    axes.plot(ends, ends, color=style.MUTED, linewidth=1, label="as predicted")
    axes.set_xlabel("AP50 after cloud FL, predicted by the curve; labels: edge/cloud rounds")
    axes.set_ylabel(f"trained, mean of {len(results.seeds)} seeds without\ntheir levels, 95 % interval")
    axes.grid(visible=True)
    handles, labels = axes.get_legend_handles_labels()
    style.key(figure, [*dict(zip(labels, handles, strict=True)).values()])
    return style.png(figure)


def _run(out: Path, options: Options) -> Outcome[PlanRanking]:
    recipe, plans = options.load("plan_ranking", shrink_recipe), TOY if options.quick else PLANS
    seeds = range(recipe.seed, recipe.seed + options.seeds)
    recipes = list_recipes(recipe, plans, seeds)
    with options.show_steps(options.title) as notify:
        runs = run_several(recipes, out, **options.how(notify))
    trained: dict[str, list[TrainedPlan]] = {}
    for run in runs:
        trained.setdefault(str(run.recipe.seed), []).append(read_plan(run))
    results = rank_plans(trained, predict(plans), recipe.model_dump(mode="json", exclude={"seed"}))
    return Outcome(results, {"ranking.png": draw_ranking(results)}, results.sentences())


EXPERIMENT = Experiment(PlanRanking, _run, tabulate_ranking, seeds=4, recipe="plan_ranking")
