"""Markdown tables of the comparison of corner cases."""

import numpy as np

from flcav.experiments.corner_cases.run import TOWNS, CornerCaseResult
from flcav.statistics.verdicts import tabulate_means
from flcav.storage.markdown import format_table


def corner_case_tables(results: CornerCaseResult) -> dict[str, str]:
    """Return Markdown by name: scores, differences, seeds."""
    return {
        "scores": _scores(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "seeds": _seeds(results),
    }


def _scores(results: CornerCaseResult) -> str:
    rows = []
    for town, arms in TOWNS.items():
        for arm in arms:
            targets = np.mean([seed[town][arm].targets for seed in results.seeds.values()])
            means = (results.rare[town][arm].describe(), results.every[town][arm].describe())
            rows.append([town, arm, *means, f"{targets:.0f}"])
    return format_table(("town", "arm", "AP50 of rare kinds", "AP50 of all objects", "rare targets a seed"), rows)


def _seeds(results: CornerCaseResult) -> str:
    rows = [
        [
            f"{town}, {arm}",
            *(f"{own[town][arm].rare:.3f}, {own[town][arm].every:.3f}" for own in results.seeds.values()),
        ]
        for town, arms in TOWNS.items()
        for arm in arms
    ]
    return format_table(("AP50 of rare kinds, of all", *(f"seed {seed}" for seed in results.seeds)), rows)
