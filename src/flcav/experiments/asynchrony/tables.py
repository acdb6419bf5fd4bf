"""Markdown tables of asynchronous against synchronous rounds."""

import numpy as np

from flcav.experiments.asynchrony.run import MEASURES, MEGABYTES, RIVALS, SECONDS, SETTINGS, WAITS, AsynchronyResult
from flcav.statistics.verdicts import judge_means
from flcav.storage.markdown import format_table


def asynchrony_tables(results: AsynchronyResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, differences."""
    judged, accuracy, differences = judge_means(results.claims), [], []
    for setting in SETTINGS:
        of_setting = results.accuracy[setting]
        for rival in RIVALS:
            own = [seed[rival] for seed in results.trajectories[setting].values()]
            means = [of_setting[measure][rival].describe() for measure in MEASURES]
            took = [f"{np.mean([each.took[measure] for each in own]):.2f}" for measure in (MEGABYTES, SECONDS)]
            updates, stale = (
                float(np.mean(each)) for each in zip(*((t.updates, t.staleness) for t in own), strict=True)
            )
            rest = [means[0], took[0], means[1], took[1], f"{updates:.0f}", f"{stale:.2f}"]
            accuracy.append([setting, rival, *rest])
            for measure in MEASURES if rival != WAITS else ():
                one, name = results.differences[setting][measure][rival], f"{setting}, {measure}: {rival}"
                verdict = judged[name]
                row = [setting, measure, rival, one.describe(sign=True), verdict.p_cell, verdict.verdict]
                differences.append([*row, verdict.takes_cell])
    heads = (
        f"vehicles, {len(results.stragglers)} seeds",
        "rounds",
        "accuracy at equal megabytes",
        "s by then",
        "accuracy at equal seconds",
        "MB up by then",
        "updates by then",
        "their staleness",
    )
    more = "if undecided: seeds that detect a difference of the observed size"
    told = ("vehicles", "at", "rounds", "accuracy - that of waiting", "p, corrected", "claim that it is positive", more)
    return {"accuracy": format_table(heads, accuracy), "differences": format_table(told, differences)}
