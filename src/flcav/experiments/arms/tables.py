"""Markdown tables of the comparison of arms."""

from collections import Counter

from flcav.experiments.arms.run import ARMS, ArmsResult
from flcav.markdown import format_table
from flcav.verdicts import HELD, NOT_HELD, UNDECIDED, verdict


def tables(results: ArmsResult) -> dict[str, str]:
    """Return Markdown by name: grid, ring, differences, seeds."""
    return {
        "grid": _town(results, "grid"),
        "ring": _town(results, "ring"),
        "differences": _differences(results),
        "seeds": _seeds(results),
    }


def _town(results: ArmsResult, town: str) -> str:
    """Return AP by arm; in grid, which has an oracle, also the fraction of the gap to it that each arm closes."""
    summary = results.summary
    closed = summary.gap_closed if town == "grid" else {}
    rows = [
        [arm, summary.ap50[town][arm].describe(), summary.ap70[town][arm].describe()]
        + ([closed[arm].describe() if arm in closed else ""] if closed else [])
        for arm in ARMS[town]
    ]
    return format_table((f"arm on `{town}`", "AP50", "AP70", *(["gap closed"] if closed else [])), rows)


def _differences(results: ArmsResult) -> str:
    rows = []
    for name, mean in results.summary.differences.items():
        own = [seed.differences[name] for seed in results.seeds]
        times = Counter(verdict(each.low, each.high) for each in own)
        counted = " / ".join(str(times[each]) for each in (HELD, UNDECIDED, NOT_HELD))
        rows.append([name, mean.describe(sign=True), counted])
    header = (
        "difference in AP50",
        "mean over seeds",
        "seeds whose own 95 % scene interval is above 0 / contains 0 / below 0",
    )
    return format_table(header, rows)


def _seeds(results: ArmsResult) -> str:
    rows = []
    for seed in results.seeds:
        placed = seed.placement["grid"]
        covered = {pole.pole: pole.covered for pole in placed.coverage}
        used = seed.used_mb["edge + cloud FL"]
        rows.append(
            [
                seed.seed,
                f"{seed.plan.samples}, {seed.plan.edge_rounds}, {seed.plan.cloud_rounds}",
                placed.errors,
                *(f"{pole}: {covered[pole]}" for pole in (placed.chosen, placed.densest)),
                *(f"{used[link]:.1f} MB" for link in ("wireless", "wireline")),
            ]
        )
    header = (
        "seed",
        "plan: samples, edge, cloud rounds",
        "errors",
        "VRCSP pole covers",
        "densest pole covers",
        "wireless used",
        "wireline used",
    )
    return format_table(header, rows)
