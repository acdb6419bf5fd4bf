"""Markdown tables of the attacks."""

from flcav.experiments.attacks.faults import LIES, STRATEGIES, FaultsResult
from flcav.experiments.attacks.leakage import LeakageResult, NoiseLevel
from flcav.experiments.attacks.withstood import (
    ATTACKERS,
    ATTACKS,
    CLIENTS,
    NONE,
    RULES,
    UNLIKENESS,
    WithstoodResult,
)
from flcav.statistics.verdicts import Claim, judge
from flcav.storage.markdown import format_table

THIRTY = 6  # attackers of 20, whom one table has in full


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


def withstood_tables(results: WithstoodResult) -> dict[str, str]:
    """Return Markdown by name: not withstood, worst, thirty."""
    failing, worst, whole = [], [], []
    for name in UNLIKENESS:
        for count in ATTACKERS:
            share = f"{100 * count // CLIENTS} %"
            own = [each for each in results.attacked if (each.unlikeness, each.attackers) == (name, count)]
            told = [", ".join(each.attack for each in own if not each.withstands(rule)) or "–" for rule in RULES]
            failing.append([name, share, *told])
            hardest = [results.worst(name, count, rule).accuracy[rule].mean for rule in RULES]
            worst.append([name, share, *(f"{accuracy:.2f}" for accuracy in hardest)])
        for attack in (NONE, *ATTACKS):
            (row,) = [each for each in results.rows_of(name, attack) if each.attackers == THIRTY]
            whole.append([name, attack, *(row.accuracy[rule].describe() for rule in RULES)])
    counts = ["all", "", *(f"{results.count(rule)} of {len(results.attacked)} withstood" for rule in RULES)]
    return {
        "not withstood": format_table(("data", "attackers", *RULES), [*failing, counts]),
        "worst": format_table(("data", "attackers", *RULES), worst),
        "thirty": format_table((f"data, {THIRTY} of {CLIENTS} attack", "attack", *RULES), whole),
    }
