"""Markdown tables of the attacks."""

from flcav.experiments.attacks.faults import LIES, STRATEGIES, FaultsResult
from flcav.markdown import format_table
from flcav.verdicts import Claim, format_p, judge


def fault_tables(results: FaultsResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, gained."""
    rows = [[lie, *(results.accuracy[lie][name].describe() for name in STRATEGIES)] for lie in LIES]
    pairs = [(lie, name) for lie in LIES for name in STRATEGIES if name in results.gained[lie]]
    judged = judge([Claim(results.gained[lie][name]) for lie, name in pairs])
    gained = []
    for (lie, name), one in zip(pairs, judged, strict=True):
        p = "" if one.p is None else format_p(one.p)
        gained.append([lie, name, results.gained[lie][name].describe(sign=True), p, one.verdict])
    claim = "claim that it is positive"
    return {
        "accuracy": format_table((f"lie of 3 of 10 vehicles, {len(results.seeds)} seeds", *STRATEGIES), rows),
        "gained": format_table(("lie", "strategy", "accuracy - FedAvg's", "p, corrected", claim), gained),
    }
