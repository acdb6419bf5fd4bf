"""Markdown tables of the comparison of labels."""

import numpy as np

from flcav.experiments.distillation.run import ARMS, PRETRAINED, DistillationResult
from flcav.statistics.verdicts import tabulate_means
from flcav.storage.markdown import format_table


def tables(results: DistillationResult) -> dict[str, str]:
    """Return Markdown by name: arms, differences, labels."""
    return {
        "arms": _arms(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "labels": _labels(results),
    }


def _arms(results: DistillationResult) -> str:
    rows = []
    for name in ARMS:
        own = [seed[name] for seed in results.seeds.values()]
        ap70, sent = (float(np.mean([getattr(each, field) for each in own])) for field in ("ap70", "up_mb"))
        rows.append([name, results.ap50[name].describe(), f"{ap70:.3f}", f"{sent:.2f} MB" if sent else ""])
    return format_table(("stage II learns from", "AP50", "AP70, mean", "wireless uplink of stage II, mean"), rows)


def _labels(results: DistillationResult) -> str:
    """Return precision and recall of the labels before the first and the last round, means over seeds."""
    rows = []
    for name in ARMS:
        if name == PRETRAINED:
            continue
        cells = []
        for place in (0, -1):
            found = [seed[name].labels[place] for seed in results.seeds.values() if seed[name].labels]
            for field in ("precision", "recall"):
                known = [value for each in found if (value := getattr(each, field)) is not None]
                cells.append(f"{np.mean(known):.3f}" if known else "")
        rows.append([name, *cells])
    at = (f"{name}, {when} round" for when in ("first", "last") for name in ("precision", "recall"))
    return format_table(("stage II learns from", *at), rows)
