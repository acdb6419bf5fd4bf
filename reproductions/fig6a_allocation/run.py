"""Validation of MLGRA by training (Wang et al., IEEE Network 37(3), 2023, Fig. 6a): joint plan against equal stages.

The plans are arms of recipes/runs/allocation.yaml. Both have the same budgets (a quarter of the recipe's, the recipe's,
or four times as much), the same learning curve, and the same limits: the counts that the curve's history covers. Runs
of a seed share their recorded frames; each places its sensors by the errors of its own pretrained network. The score
that the curve predicts after each stage is compared with the score after training, in the mean of the federating towns,
which is what the history measures.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from flcav.experiments.experiment import Experiment, Options, Outcome, use_demo_size
from flcav.report import style
from flcav.report.charts import plans
from flcav.reproductions.fig6a_allocation.findings import (
    COUNTS,
    EQUAL,
    JOINT,
    MEAN,
    STAGE_NAMES,
    AllocationResult,
    AllocationSeed,
    AllocationSummary,
    AtBudgets,
    Planned,
    StageAP,
    allocation_findings,
)
from flcav.runs.provenance import provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, Budgets, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.running import run_several
from flcav.runs.tables import load_known_history
from flcav.statistics.estimates import Estimate, average_estimates
from flcav.statistics.seeds import mean_over_seeds
from flcav.storage.markdown import format_bullets, format_signed, format_table

TASK = "objects"
PLANS = (EQUAL, JOINT)
BUDGETS = (0.25, 1.0, 4.0)  # multiples of the recipe's budgets
ARM_OF = {EQUAL: "equal", JOINT: MAIN}
STAGES = (PRETRAIN, EDGE, CLOUD)


def budget_recipes(recipe: RunRecipe, seeds: Sequence[int], factors: Sequence[float] = BUDGETS) -> dict[str, RunRecipe]:
    """Return the recipes of the runs, one for each factor of the budgets and seed, by the names of their folders."""
    return {
        _name_run(factor, seed): recipe.model_copy(
            update={
                "seed": seed,
                "budgets_mb": Budgets(
                    wireless=factor * recipe.budgets_mb.wireless, wireline=factor * recipe.budgets_mb.wireline
                ),
            }
        )
        for factor, seed in product(factors, seeds)
    }


def plans_differ(run: Run) -> bool:
    """Return whether the joint plan of a run differs from equal stages in samples or rounds.

    Where it does not, both arms are one training, and more seeds would show no difference.
    """
    return not one_seed(run).coincide


def _name_run(factor: float, seed: int) -> str:
    return f"x{factor:g}-seed{seed}"


def compare_plans(recipe: RunRecipe, runs: Mapping[float, Sequence[Run]]) -> AllocationResult:
    """Return the results of both plans of `recipe`, from the runs of all seeds by factor of the budgets.

    Raises `InputError` where no sensor was placed in a region.
    """
    rows = {factor: tuple(one_seed(run) for run in seeds) for factor, seeds in runs.items()}
    budgets = [AtBudgets(factor, seeds, summarise(seeds)) for factor, seeds in rows.items()]
    settings, history = recipe.model_dump(mode="json", exclude={"seed"}), _history_ranges()
    found = allocation_findings(budgets, history)
    with_findings = tuple(replace(results, findings=findings) for results, findings in zip(budgets, found, strict=True))
    return AllocationResult(history, with_findings, recipe=settings, provenance=provenance())


def one_seed(run: Run) -> AllocationSeed:
    """Return the results of both plans in one seed's run.

    Predictions are those of the plans made before the run: plans made anew during the run know its scores.
    """
    towns = run.recipe.with_role("federate")
    arms = {name: run.arms[arm] for name, arm in ARM_OF.items()}
    plan_of = {name: arm.plan.tasks[TASK] for name, arm in arms.items()}
    estimates = {
        (difference.region, difference.stage): difference.over_scenes
        for difference in run.differences
        if (difference.arm, difference.before_arm) == (MAIN, ARM_OF[EQUAL])
    }
    predicted = {name: dict(arm.plans[0].tasks[TASK].predicted or {}) for name, arm in arms.items()}
    realised = {
        town: {name: {stage: StageAP(_ap50(run, arm, stage, town)) for stage in STAGES} for name, arm in ARM_OF.items()}
        for town in towns
    }
    differences = {town: {stage: _difference(estimates.get((town, stage))) for stage in STAGES} for town in towns}
    return AllocationSeed(
        seed=run.recipe.seed,
        plans={
            name: Planned(
                plan.samples,
                plan.edge_rounds,
                plan.cloud_rounds,
                plan.wireless_mb,
                plan.wireline_mb,
                predicted_error=1 - predicted[name][CLOUD],
            )
            for name, plan in plan_of.items()
        },
        predicted=predicted,
        realised={MEAN: _average_reached(realised), **realised},
        differences={
            MEAN: {stage: average_estimates([differences[town][stage] for town in towns]) for stage in STAGES},
            **differences,
        },
        poles={name: {placed.region: placed.first for placed in arm.placed} for name, arm in arms.items()},
        ledger={name: arm.links for name, arm in arms.items()},
    )


def _average_reached(towns: Mapping[str, Mapping[str, Mapping[str, StageAP]]]) -> dict[str, dict[str, StageAP]]:
    """Return AP50 by plan and stage in the mean of the towns."""
    return {
        name: {
            stage: StageAP(float(np.mean([by_plan[name][stage].ap50 for by_plan in towns.values()])))
            for stage in STAGES
        }
        for name in PLANS
    }


def _ap50(run: Run, arm: str, stage: str, town: str) -> float:
    return run.test(arm=arm, stage=stage, region=town, task=TASK).estimate.mean


def _difference(estimate: Estimate | None) -> Estimate:
    """Return the difference; 0 for None: both plans are equal and share their steps."""
    return Estimate(0.0, 0.0, 0.0) if estimate is None else estimate


def _history_ranges() -> dict[str, tuple[float, float]]:
    """Return the least and most of each count in the history that both plans are predicted from."""
    columns = load_known_history(TASK).resources.T
    return {name: (float(column.min()), float(column.max())) for name, column in zip(COUNTS, columns, strict=True)}


def summarise(seeds: Sequence[AllocationSeed]) -> AllocationSummary:
    """Return means over seeds with their 95 % intervals; differences are joint minus equal stages, paired by seed."""

    towns = tuple(seeds[0].realised)

    def realised(town: str, name: str, stage: str) -> list[float]:
        return [seed.realised[town][name][stage].ap50 for seed in seeds]

    def predicted(name: str, stage: str) -> list[float]:
        return [seed.predicted[name][stage] for seed in seeds]

    return AllocationSummary(
        predicted={name: {stage: float(np.mean(predicted(name, stage))) for stage in STAGES} for name in PLANS},
        realised={
            town: {
                name: {stage: mean_over_seeds(realised(town, name, stage), share=True) for stage in STAGES}
                for name in PLANS
            }
            for town in towns
        },
        predicted_difference={
            stage: float(np.mean(np.subtract(predicted(JOINT, stage), predicted(EQUAL, stage)))) for stage in STAGES
        },
        realised_difference={
            town: {
                stage: mean_over_seeds(np.subtract(realised(town, JOINT, stage), realised(town, EQUAL, stage)).tolist())
                for stage in STAGES
            }
            for town in towns
        },
    )


def draw_allocation(results: AllocationResult) -> bytes:
    """Return predicted and realised AP of both plans, and their paired differences, as a PNG; a row per budgets."""
    return style.png(plans.predicted_and_realised({each.name: _collect(each) for each in results.budgets}, MEAN))


def _collect(results: AtBudgets) -> plans.PlansReached:
    summary, seeds = results.summary, results.seeds
    ap = {
        name: {
            stage: plans.StageReached(
                summary.predicted[name][stage],
                summary.realised[MEAN][name][stage],
                tuple(seed.realised[MEAN][name][stage].ap50 for seed in seeds),
            )
            for stage in STAGES
        }
        for name in PLANS
    }
    differences = {
        stage: plans.StageReached(
            summary.predicted_difference[stage],
            summary.realised_difference[MEAN][stage],
            tuple(seed.differences[MEAN][stage].mean for seed in seeds),
        )
        for stage in STAGES
    }
    return plans.PlansReached(ap, differences)


Row = Sequence[str | float]
NAMES = {EQUAL: "equal stages", JOINT: "joint"}


def tables(results: AllocationResult) -> dict[str, str]:
    """Return Markdown by name: findings (a list), plans, accuracy, differences, megabytes."""
    return {
        "findings": format_bullets(
            f"Budgets {each.name}. *{finding.question}* **{finding.verdict}.** {finding.sentence}"
            for each in results.budgets
            for finding in each.findings
        ),
        "plans": _table(
            results,
            ("seed", "plan", "samples", "edge rounds", "cloud rounds", "predicted AP50", "poles, grid / ring"),
            _plans,
        ),
        "accuracy": _table(
            results,
            ("after", "plan", "predicted", *(f"AP50, {town}" for town in _towns(results))),
            _accuracy,
        ),
        "differences": _table(
            results,
            ("joint - equal stages on", "after", "predicted", "trained, over seeds", "each seed, over its test scenes"),
            _differences,
        ),
        "megabytes": _table(
            results, ("seed", "plan", "uplink", "budget MB", "planned MB", "sent MB", "sent - planned"), _megabytes
        ),
    }


def _table(results: AllocationResult, header: Sequence[str], rows: Callable[[AtBudgets], Sequence[Row]]) -> str:
    return format_table(("budgets", *header), [[each.name, *row] for each in results.budgets for row in rows(each)])


def _towns(results: AllocationResult) -> list[str]:
    return [*results.budgets[0].summary.realised]


def _plans(results: AtBudgets) -> list[Row]:
    rows: list[Row] = []
    for seed in results.seeds:
        for name, plan in seed.plans.items():
            counts = plan.counts.values()
            poles = " / ".join(str(pole) for pole in seed.poles[name].values())
            rows.append([seed.seed, NAMES[name], *counts, f"{1 - plan.predicted_error:.3f}", poles])
    return rows


def _accuracy(results: AtBudgets) -> list[Row]:
    summary = results.summary
    return [
        [stage, NAMES[name], f"{summary.predicted[name][key]:.3f}"]
        + [summary.realised[town][name][key].describe() for town in summary.realised]
        for key, stage in STAGE_NAMES.items()
        for name in (EQUAL, JOINT)
    ]


def _differences(results: AtBudgets) -> list[Row]:
    summary = results.summary
    rows: list[Row] = []
    for town, stages in summary.realised_difference.items():
        for key, stage in STAGE_NAMES.items():
            predicted = format_signed(summary.predicted_difference[key]) if town == MEAN else ""
            estimates = [seed.differences[town][key] for seed in results.seeds]
            per_seed = ", ".join(estimate.describe(sign=True) for estimate in estimates)
            rows.append([town, stage, predicted, stages[key].describe(sign=True), per_seed])
    return rows


def _megabytes(results: AtBudgets) -> list[Row]:
    return [
        [seed.seed, NAMES[name], link]
        + [f"{mb:.1f}" for mb in (row.budget_mb, row.planned_mb, row.used_mb)]
        + [format_signed(row.used_mb - row.planned_mb, 2)]
        for seed in results.seeds
        for name, book in seed.ledger.items()
        for link, row in book.items()
    ]


def _run(out: Path, options: Options) -> Outcome[AllocationResult]:
    """Run the first seed with all budgets, and further seeds where that run's plans differ."""
    recipe = options.load("allocation", use_demo_size)
    with options.show_steps(options.title) as notify:

        def finish(numbers: Sequence[int], factors: Sequence[float]) -> dict[float, list[Run]]:
            runs = iter(run_several(budget_recipes(recipe, numbers, factors), out, **options.how(notify)))
            return {factor: [next(runs) for _ in numbers] for factor in factors}

        first = finish([1], BUDGETS)
        others = finish(range(2, options.seeds + 1), [factor for factor, (run,) in first.items() if plans_differ(run)])
    results = compare_plans(
        recipe, {factor: [*first_runs, *others.get(factor, [])] for factor, first_runs in first.items()}
    )
    sentences = [
        f"Budgets {each.name}. {finding.question} {finding.verdict}. {finding.sentence}"
        for each in results.budgets
        for finding in each.findings
    ]
    return Outcome(results, {"plans.png": draw_allocation(results)}, sentences)


EXPERIMENT = Experiment(AllocationResult, _run, tables, recipe="allocation")
