"""Markdown tables of the failure search."""

import numpy as np

from flcav.experiments.failure_search.run import NAMES, FailureSearchResult
from flcav.storage.markdown import format_table


def failure_search_tables(results: FailureSearchResult) -> dict[str, str]:
    """Return Markdown by name: found, ratios."""
    rows = []
    for rule, own in results.found.items():
        frames, failing, failures = (
            float(np.mean([getattr(each, name) for each in own])) for name in ("frames", "failing", "failures")
        )
        half = float(np.mean([each.growth[len(each.growth) // 2 - 1] for each in own]))
        mean = results.distinct[rule].describe()
        row = [f"{frames:.0f}", f"{failing:.1f}", f"{failures:.1f}", f"{half:.1f}", mean, str(results.together[rule])]
        rows.append([NAMES[rule], *row])
    columns = ("rule", "frames", "with a failure", "failures", "distinct after half", "distinct", "all seeds together")
    told = [
        [f"{NAMES[one]} / {NAMES[other]}", results.ratios[name].describe()]
        for name in results.ratios
        for one, other in [name.split(" / ")]
    ]
    return {
        "found": format_table(columns, rows),
        "ratios": format_table(("distinct failures", "ratio, interval"), told),
    }
