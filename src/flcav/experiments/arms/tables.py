"""Markdown tables of the comparison of arms."""

from collections import Counter

from flcav.experiments.arms.run import ARMS, EFFECT, ArmsResult, judge_differences
from flcav.statistics.power import MOST_SEEDS, plan_seeds
from flcav.statistics.seeds import LEVEL, MeanOverSeeds, half_width
from flcav.statistics.verdicts import ESTIMATE, HELD, NOT_HELD, UNDECIDED, verdict
from flcav.storage.markdown import format_table


def tables(results: ArmsResult) -> dict[str, str]:
    """Return Markdown by name: grid, ring, differences, power, seeds."""
    return {
        "grid": _town(results, "grid"),
        "ring": _town(results, "ring"),
        "differences": _differences(results),
        "power": _power(results),
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
        if arm in summary.ap50[town]
    ]
    return format_table((f"arm on `{town}`", "AP50", "AP70", *(["gap closed"] if closed else [])), rows)


def _differences(results: ArmsResult) -> str:
    rows, judged = [], judge_differences(results.summary)
    for name, mean in results.summary.differences.items():
        own = [seed.differences[name] for seed in results.seeds]
        times = Counter(verdict(each.low, each.high) for each in own)
        counted = " / ".join(str(times[each]) for each in (HELD, UNDECIDED, NOT_HELD))
        one = judged.get(name)
        told = (one.p_cell, one.verdict) if one else ("", ESTIMATE)
        rows.append([name, mean.describe(sign=True), *told, counted])
    header = (
        "difference in AP50",
        "mean over seeds",
        "p, corrected",
        "claim that it is positive",
        "seeds whose own 95 % scene interval is above 0 / contains 0 / below 0",
    )
    return format_table(header, rows)


def _power(results: ArmsResult) -> str:
    """Return how many seeds it takes to tell `EFFECT`, and differences of the size found, after correction."""
    judged, rows = judge_differences(results.summary), []
    for name, mean in results.summary.differences.items():
        one = judged.get(name)
        level = LEVEL / max(one.family, 1) if one else LEVEL
        half = f"{half_width(mean.sd, mean.seeds):.3f}" if mean.seeds > 1 else ""
        wanted = plan_seeds(EFFECT, mean.sd, level) if mean.known else None
        rows.append([name, f"{mean.sd:.3f}", half, _told(wanted, mean), one.takes_cell if one else ""])
    header = (
        "difference in AP50",
        "standard deviation over seeds",
        f"half width of the interval of {len(results.seeds)} seeds",
        f"seeds that detect {EFFECT}",
        "if undecided: seeds that detect a difference of the observed size",
    )
    return format_table(header, rows)


def _told(seeds: int | None, mean: MeanOverSeeds) -> str:
    """Return a number of seeds as text; None: too many, or not known."""
    if not mean.known:
        return ""
    return f"more than {MOST_SEEDS}" if seeds is None else str(seeds)


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
