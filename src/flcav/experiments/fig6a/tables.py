"""Markdown tables of Fig. 6a."""

from flcav.experiments.fig6a.findings import STAGE_NAMES
from flcav.experiments.fig6a.results import EQUAL, JOINT, TOWN, AllocationResult
from flcav.markdown import format_bullets, format_signed, format_table

NAMES = {EQUAL: "equal stages", JOINT: "joint"}


def tables(results: AllocationResult) -> dict[str, str]:
    """Return Markdown by name: findings (a list), plans, accuracy, differences, megabytes."""
    return {
        "findings": format_bullets(
            f"*{finding.question}* **{finding.verdict}.** {finding.sentence}" for finding in results.findings
        ),
        "plans": _plans(results),
        "accuracy": _accuracy(results),
        "differences": _differences(results),
        "megabytes": _megabytes(results),
    }


def _plans(results: AllocationResult) -> str:
    rows = []
    for seed in results.seeds:
        for name, plan in seed.plans.items():
            counts = plan.counts.values()
            poles = " / ".join(str(pole) for pole in seed.poles[name].values())
            rows.append([seed.seed, NAMES[name], *counts, f"{1 - plan.predicted_error:.3f}", poles])
    header = ("seed", "plan", "samples", "edge rounds", "cloud rounds", "predicted AP50", "poles, grid / ring")
    return format_table(header, rows)


def _accuracy(results: AllocationResult) -> str:
    summary = results.summary
    rows = [
        [stage, NAMES[name], f"{summary.predicted[name][key]:.3f}"]
        + [summary.realised[town][name][key].describe() for town in summary.realised]
        for key, stage in STAGE_NAMES.items()
        for name in (EQUAL, JOINT)
    ]
    return format_table(("after", "plan", f"predicted on {TOWN}", *(f"AP50 on {t}" for t in summary.realised)), rows)


def _differences(results: AllocationResult) -> str:
    summary = results.summary
    rows = []
    for town, stages in summary.realised_difference.items():
        for key, stage in STAGE_NAMES.items():
            predicted = format_signed(summary.predicted_difference[key]) if town == TOWN else ""
            own = [seed.differences[town][key] for seed in results.seeds]
            per_seed = ", ".join(each.describe(sign=True) for each in own)
            rows.append([town, stage, predicted, stages[key].describe(sign=True), per_seed])
    header = ("joint - equal stages on", "after", "predicted", "trained, over seeds", "each seed, over its test scenes")
    return format_table(header, rows)


def _megabytes(results: AllocationResult) -> str:
    rows = [
        [seed.seed, NAMES[name], link]
        + [f"{mb:.1f}" for mb in (row.budget_mb, row.planned_mb, row.used_mb)]
        + [format_signed(row.used_mb - row.planned_mb, 2)]
        for seed in results.seeds
        for name, book in seed.ledger.items()
        for link, row in book.items()
    ]
    return format_table(("seed", "plan", "uplink", "budget MB", "planned MB", "sent MB", "sent - planned"), rows)
