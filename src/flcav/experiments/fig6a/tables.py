"""Markdown tables of Fig. 6a."""

from collections.abc import Callable, Sequence

from flcav.experiments.fig6a.findings import STAGE_NAMES
from flcav.experiments.fig6a.results import EQUAL, JOINT, MEAN, AllocationResult, AtBudgets
from flcav.storage.markdown import format_bullets, format_signed, format_table

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
            own = [seed.differences[town][key] for seed in results.seeds]
            per_seed = ", ".join(each.describe(sign=True) for each in own)
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
