"""Differences of several rivals to one of them, by setting and measure, in means over seeds."""

from collections.abc import Mapping

from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import judge_means

Differences = Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by setting, measure and rival


def name_differences(differences: Differences) -> dict[str, MeanOverSeeds]:
    """Return all differences by name, whose verdicts are corrected together."""
    return {
        f"{setting}, {measure}: {rival}": mean
        for setting, of_setting in differences.items()
        for measure, of_measure in of_setting.items()
        for rival, mean in of_measure.items()
    }


def tell_differences(differences: Differences, reference: str) -> list[str]:
    """Return the differences to the `reference` in words."""
    claims = name_differences(differences)
    judged = judge_means(claims)
    return [
        f"{name} - {reference}: {mean.describe(sign=True)}, {judged[name].describe()}" for name, mean in claims.items()
    ]
