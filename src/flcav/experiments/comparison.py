"""Comparisons of arms over seeds: means and paired differences with their intervals, verdicts, and tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

from flcav.runs.analysis.histories import gap_closed
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import Claim, judge, judge_means
from flcav.storage.markdown import format_table

ArmT = TypeVar("ArmT")
Seeds = Mapping[str, Mapping[str, ArmT]]  # results by seed and arm
Differences = Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by setting, measure and rival


def average_arms(
    seeds: Seeds[ArmT], arms: Iterable[str], value: Callable[[ArmT], float], *, share: bool = True
) -> dict[str, MeanOverSeeds]:
    """Return the mean over seeds of a value of each arm; `share`: the value is in [0, 1]."""
    return {arm: mean_over_seeds([value(seed[arm]) for seed in seeds.values()], share=share) for arm in arms}


def mean_difference(seeds: Seeds[ArmT], after: str, before: str, value: Callable[[ArmT], float]) -> MeanOverSeeds:
    """Return the mean over seeds of the paired difference of a value between two arms, `after` - `before`."""
    return mean_over_seeds([value(seed[after]) - value(seed[before]) for seed in seeds.values()])


def close_gap(seeds: Seeds[ArmT], start: str, arm: str, end: str, value: Callable[[ArmT], float]) -> MeanOverSeeds:
    """Return the mean over seeds of the share of the gap between the arms `start` and `end` that an arm closes."""
    return mean_over_seeds([gap_closed(*(value(seed[name]) for name in (start, arm, end))) for seed in seeds.values()])


def compare_arms(
    seeds: Seeds[ArmT], pairs: Iterable[tuple[str, str]], value: Callable[[ArmT], float]
) -> dict[str, MeanOverSeeds]:
    """Return `mean_difference` of each pair of arms (after, before), by "after - before"."""
    return {f"{after} - {before}": mean_difference(seeds, after, before, value) for after, before in pairs}


def tabulate_seeds(title: str, seeds: Seeds[ArmT], arms: Iterable[str], tell: Callable[[ArmT], str]) -> str:
    """Return a Markdown table with a row per arm and a column per seed."""
    rows = [[arm, *(tell(seed[arm]) for seed in seeds.values())] for arm in arms]
    return format_table((title, *(f"seed {seed}" for seed in seeds)), rows)


def tabulate_verdicts(
    heads: Sequence[str], difference: str, claims: Mapping[tuple[str, ...], MeanOverSeeds], effect: str = "a difference"
) -> str:
    """Return a Markdown table with a row per claim that a `difference` is positive; all are corrected together."""
    judged = judge([Claim(mean) for mean in claims.values()])
    rows = [
        [*name, mean.describe(sign=True), one.p_cell, one.verdict, one.takes_cell]
        for (name, mean), one in zip(claims.items(), judged, strict=True)
    ]
    more = f"if undecided: seeds that detect {effect} of the observed size"
    return format_table((*heads, difference, "p, corrected", "claim that it is positive", more), rows)


def describe_differences(differences: Differences, reference: str) -> list[str]:
    """Return the differences to the `reference` in words; their verdicts are corrected together."""
    claims = {
        f"{setting}, {measure}: {rival}": mean
        for setting, of_setting in differences.items()
        for measure, of_measure in of_setting.items()
        for rival, mean in of_measure.items()
    }
    judged = judge_means(claims)
    return [
        f"{name} - {reference}: {mean.describe(sign=True)}, {judged[name].describe()}" for name, mean in claims.items()
    ]
