"""Markdown tables of redundant tasks against an even split."""

import numpy as np

from flcav.experiments.redundant_tasks.run import RedundantTasksResult
from flcav.experiments.redundant_tasks.scenarios import SPLITS
from flcav.statistics.verdicts import tabulate_means
from flcav.storage.markdown import format_table


def redundant_tasks_tables(results: RedundantTasksResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, differences, scenarios."""
    return {
        "accuracy": _accuracy(results),
        "differences": tabulate_means("AP50", results.differences),
        "scenarios": _scenarios(results),
    }


def _accuracy(results: RedundantTasksResult) -> str:
    splits = [*next(iter(results.ap50.values()))]
    rows = [
        [
            split,
            f"{results.up_mb[split]:.2f}" if split in results.up_mb else "0",
            *(of[split].describe() for of in results.ap50.values()),
        ]
        for split in splits
    ]
    return format_table(("tasks", "MB up", *(f"AP50, {score}" for score in results.ap50)), rows)


def _scenarios(results: RedundantTasksResult) -> str:
    names = dict.fromkeys(own.name for tried in results.seeds.values() for own in tried)
    rows = []
    for name in names:
        own = [each for tried in results.seeds.values() for each in tried if each.name == name]
        complexity = float(np.mean([each.complexity.total for each in own]))
        errors = float(np.mean([each.complexity.errors for each in own]))
        by_rule = ", ".join(str(each.by_rule) for each in own)
        shares = [f"{np.mean([each.tasks[split] for each in own]):.1f}" for split in SPLITS]
        reached = [f"{np.mean([each.ap50[str(each.tasks[split])] for each in own]):.3f}" for split in SPLITS]
        start = f"{np.mean([each.ap50['0'] for each in own]):.3f}"
        cells = [f"{share} tasks: {ap}" for share, ap in zip(shares, reached, strict=True)]
        rows.append([name, f"{complexity:.2f}", f"{errors:.2f}", by_rule, start, *cells])
    heads = ("complexity", "of it errors", "tasks by the rule, by seed", "AP50, pretrained", *SPLITS)
    return format_table(("scenario", *heads), rows)
