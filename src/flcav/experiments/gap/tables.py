"""Markdown tables of where the gap is."""

import numpy as np

from flcav.experiments.gap.run import ARMS, AT_HOME, HOME, GapArm, GapResult
from flcav.statistics.verdicts import tabulate_means
from flcav.storage.markdown import format_table


def gap_tables(results: GapResult) -> dict[str, str]:
    """Return Markdown by name: arms, differences, home, seeds."""
    return {
        "arms": _arms(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "home": _home(results),
        "megabytes": _megabytes(results),
        "seeds": _seeds(results),
    }


def _arms(results: GapResult) -> str:
    rows = []
    for name in ARMS:
        own = [seed[name] for seed in results.seeds.values()]
        labels = (_mean([getattr(each, field) for each in own]) for field in ("precision", "recall"))
        numbers = (results.ap50, results.closed50, results.ap70, results.closed70)
        rows.append([name, *(each[name].describe() for each in numbers), *labels])
    share = "share of the gain of truth"
    titles = ("arm", "AP50", share, "AP70", share, "labels' precision", "labels' recall")
    return format_table(titles, rows)


def _home(results: GapResult) -> str:
    rows = []
    for name in AT_HOME:
        own = [seed[name] for seed in results.home.values()]
        row = [name]
        for field, change in (("ap50", results.home50), ("ap70", results.home70)):
            row += [
                _mean([getattr(each, field) for each in own]),
                change[name].describe(sign=True) if name in change else "",
            ]
        rows.append(row)
    titles = ("AP50", "against pretrained", "AP70", "against pretrained")
    return format_table((f"in {HOME}", *titles), rows)


def _megabytes(results: GapResult) -> str:
    rows = [
        [name, point.label, f"{point.mb:.1f}", point.ap50.describe()]
        for name, points in results.megabytes.items()
        for point in points
    ]
    return format_table(("training", "after", "uplink MB", "AP50"), rows)


def _seeds(results: GapResult) -> str:
    def cell(arm: GapArm) -> str:
        return f"{arm.ap50:.3f}, {arm.ap70:.3f}"

    rows = [[name, *(cell(seed[name]) for seed in results.seeds.values())] for name in ARMS]
    return format_table(("AP50, AP70", *(f"seed {seed}" for seed in results.seeds)), rows)


def _mean(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f}" if known else ""
