"""Markdown tables of the comparison of lifelong learning."""

from flcav.experiments.lifelong.run import ARMS, LifelongResult
from flcav.statistics.verdicts import tabulate_means
from flcav.storage.markdown import format_table


def lifelong_tables(results: LifelongResult) -> dict[str, str]:
    """Return Markdown by name: arms, conditions, differences, rounds, seeds."""
    return {
        "arms": _arms(results),
        "conditions": _conditions(results),
        "differences": tabulate_means("difference", results.differences),
        "rounds": _rounds(results),
        "seeds": _seeds(results),
    }


def _arms(results: LifelongResult) -> str:
    rows = []
    for arm in ARMS:
        own = results.mended[arm]
        seconds = "–" if own.seconds is None else f"{own.seconds:.0f}"
        moved = [results.backward[arm].describe(sign=True), results.forward[arm].describe(sign=True)]
        sent = [f"{results.up_mb[arm].mean:.1f}", f"{results.down_mb[arm].mean:.1f}"]
        counts = [f"{own.broken} of {own.passed}", f"{own.mended}", seconds]
        rows.append([arm, results.final[arm].describe(), *moved, *sent, *counts])
    titles = ("final mean AP50", "backward transfer", "forward transfer", "MB up", "MB down")
    return format_table(("arm", *titles, "conditions with errors", "mended", "median s until mended"), rows)


def _conditions(results: LifelongResult) -> str:
    rows = []
    for number, condition in enumerate(results.conditions):
        for arm in ARMS:
            own = results.tested[condition][arm]
            rows.append(
                [condition, arm, *(each.describe() for each in (own[0], own[number], own[number + 1], own[-1]))]
            )
    titles = ("pretrained", "before it came", "after it", "at the end")
    return format_table(("AP50 in", "arm", *titles), rows)


def _rounds(results: LifelongResult) -> str:
    rows = []
    for seed, arms in results.seeds.items():
        for arm in ARMS[:2]:
            for own in arms[arm].passed:
                seconds = "–" if own.mended_s is None else f"{own.mended_s:.0f}"
                first, last = own.scores[own.condition][0], own.scores[own.condition][-1]
                told = [f"{first:.3f}", f"{last:.3f}", f"{own.reachable:.3f}", "yes" if own.replaced else "no", seconds]
                rows.append([seed, arm, own.condition, f"{len(own.asked)}", f"{own.members}", f"{own.rounds}", *told])
    titles = ("asked", "members", "rounds", "before", "after", "reachable", "new network drives", "s until mended")
    return format_table(("seed", "arm", "condition", *titles), rows)


def _seeds(results: LifelongResult) -> str:
    rows = [
        [arm, *(f"{own[arm].final:.3f}, {own[arm].backward:+.3f}" for own in results.seeds.values())] for arm in ARMS
    ]
    return format_table(("final mean AP50, backward transfer", *(f"seed {seed}" for seed in results.seeds)), rows)
