"""Markdown tables of groups on request against a fixed roster."""

import numpy as np

from flcav.experiments.groups.run import (
    MEASURES,
    MEGABYTES,
    RIVALS,
    ROSTER,
    SETTINGS,
    TARGET,
    UNTIL,
    WHOLE,
    GroupsResult,
)
from flcav.statistics.verdicts import judge_means
from flcav.storage.markdown import format_table


def groups_tables(results: GroupsResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, groups, differences."""
    judged, accuracy, groups, differences = judge_means(results.claims), [], [], []
    for setting in SETTINGS:
        seeds = results.trajectories[setting]
        for rival in RIVALS:
            own = [seed[rival] for seed in seeds.values()]
            means = [results.accuracy[setting][measure][rival].describe() for measure in MEASURES]
            gain = results.gains[setting][WHOLE][rival].describe()
            rounds = np.mean([len(each.up_mb) - 1 for each in own])
            sent = np.mean([each.up_mb[-1] for each in own])
            until = results.until_mb[setting][rival].describe()
            accuracy.append([setting, rival, *means, f"{rounds:.1f}", f"{sent:.2f}", gain, until])
            for measure in (*MEASURES, UNTIL) if rival != ROSTER else ():
                one, verdict = (
                    results.differences[setting][measure][rival],
                    judged[f"{setting}, {measure}: {rival}"],
                )
                row = [setting, measure, rival, one.describe(sign=True), verdict.p_cell, verdict.verdict]
                differences.append([*row, verdict.takes_cell])
        for seed, rivals in sorted(seeds.items(), key=lambda each: int(each[0])):
            group = rivals[RIVALS[1]]
            told = (", ".join(group.asked), ", ".join(group.members))
            met = ", ".join(results.meet[seed]) if setting == SETTINGS[0] else "all"
            groups.append([setting, seed, met, *told, str(len(group.up_mb) - 1), f"{group.up_mb[0] * 1000:.1f}"])
    heads = (
        f"vehicles, {len(results.meet)} seeds",
        "rounds",
        f"accuracy at {MEGABYTES}",
        "accuracy after the whole plan",
        "rounds until its end",
        "MB up by then",
        "gain in accuracy per MB of it",
        f"MB up until accuracy {TARGET}",
    )
    of_groups = ("vehicles", "seed", "met the new weathers", "asked", "came", "rounds", "requests and offers, kB")
    more = "if undecided: seeds that detect a difference of the observed size"
    told = (
        "vehicles",
        "at",
        "rounds",
        "accuracy - fixed roster's, or megabytes saved",
        "p, corrected",
        "claim that it is positive",
        more,
    )
    return {
        "accuracy": format_table(heads, accuracy),
        "groups": format_table(of_groups, groups),
        "differences": format_table(told, differences),
    }
