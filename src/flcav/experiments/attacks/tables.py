"""Markdown tables of the attacks."""

from flcav.experiments.attacks.faults import LIES, STRATEGIES, FaultsResult
from flcav.experiments.attacks.leakage import LeakageResult, NoiseLevel
from flcav.statistics.verdicts import Claim, judge
from flcav.storage.markdown import format_table


def fault_tables(results: FaultsResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, gained."""
    rows = [[lie, *(results.accuracy[lie][name].describe() for name in STRATEGIES)] for lie in LIES]
    pairs = [(lie, name) for lie in LIES for name in STRATEGIES if name in results.gained[lie]]
    judged = judge([Claim(results.gained[lie][name]) for lie, name in pairs])
    gained = []
    for (lie, name), one in zip(pairs, judged, strict=True):
        found = results.gained[lie][name].describe(sign=True)
        gained.append([lie, name, found, one.p_cell, one.verdict, one.takes_cell])
    claim, seeds = "claim that it is positive", "if undecided: seeds that detect an effect of the observed size"
    return {
        "accuracy": format_table((f"attack by 3 of 10 clients, {len(results.seeds)} seeds", *STRATEGIES), rows),
        "gained": format_table(("attack", "strategy", "accuracy - FedAvg's", "p, corrected", claim, seeds), gained),
    }


def leakage_tables(results: LeakageResult) -> dict[str, str]:
    """Return Markdown by name: levels, secure."""
    names = {
        "accuracy": "accuracy",
        "membership_auc": "membership: area under the curve",
        "membership_advantage": "advantage",
        "recognised_one": "picture recognised, of a step on one",
        "recognised_round": "of an update",
    }

    def row(level: NoiseLevel) -> list[str]:
        return [level.mean[name].describe() for name in names]

    levels = [
        [level.name, "∞" if level.epsilon is None else f"{level.epsilon:.3g}", *row(level)] for level in results.levels
    ]
    shown = {"every update": results.levels[0], "a masked update": results.masked, "the sum of all": results.summed}
    return {
        "levels": format_table(("noise", "ε", *names.values()), levels),
        "secure": format_table(
            ("what the server sees", *names.values()), [[name, *row(each)] for name, each in shown.items()]
        ),
    }
