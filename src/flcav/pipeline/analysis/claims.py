"""Claims about a run's differences: primary and secondary ones, and estimates of what is lost to an upper bound.

A recipe may name its primary claims (`primary_claims`) before it is run. They are corrected for one another, and all
others, exploratory ones, apart from them. Nobody claims that the run beats an upper bound, such as an arm with an ideal
road detector: there the difference is an estimate of what is lost.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from flcav.pipeline.arms import Setting
from flcav.pipeline.labels.sources import LABEL_SOURCES
from flcav.pipeline.recipe import CLOUD, EDGE, ELSEWHERE, MAIN, RunRecipe
from flcav.pipeline.results.tests import Difference
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import Claim, Judged, judge_known

Kind = Literal["claim", "primary", "secondary", "loss"]


@dataclass(frozen=True)
class Asked:
    """The question that a difference answers, and what it is to the run: a claim, or an estimate of a loss."""

    question: str
    kind: Kind  # claim: one of a recipe that names no primary claims

    @property
    def named(self) -> str | None:
        """Return "primary" or "secondary"; None for what is neither."""
        return self.kind if self.kind in ("primary", "secondary") else None


def ask(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> Asked:
    """Return what a difference of the run itself is asked; `settings`: those of each arm."""
    question = _question(each, recipe, settings)
    if each.before_arm != MAIN and _is_bound(settings[MAIN], settings[each.before_arm], each.task):
        return Asked(question, "loss")
    if not recipe.primary_claims:
        return Asked(question, "claim")
    return Asked(question, "primary" if _name_claim(each) in recipe.primary_claims else "secondary")


def judge_asked(asked: Sequence[Asked], means: Sequence[MeanOverSeeds | None]) -> list[Judged | None]:
    """Return the verdict on each claim; primary ones are judged together, others together.

    None for what is no claim, and where there is no number (None) to judge.
    """
    found: list[Judged | None] = [None] * len(asked)
    for kind in ("claim", "primary", "secondary"):
        own = [
            None if mean is None or each.kind != kind else Claim(mean) for each, mean in zip(asked, means, strict=True)
        ]
        found = [one or old for one, old in zip(judge_known(own), found, strict=True)]
    return found


def _name_claim(each: Difference) -> str:
    """Return the name by which a recipe's `primary_claims` call a difference's claim."""
    if each.before_arm != MAIN:
        return each.before_arm
    if each.stage == EDGE:
        return EDGE
    return CLOUD if each.before_stage == EDGE else ELSEWHERE


def _is_bound(own: Setting, other: Setting, task: str) -> bool:
    """Return whether an arm is an upper bound of the run: it learns from truth that the run does not have."""
    first, second = (LABEL_SOURCES[setting.labels[task]].bound for setting in (own, other))
    return other.central == "federate" or (second and not first)


def _question(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> str:
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return "Does federated learning beat pretraining alone?"
        if each.before_stage == EDGE:
            return "Does cloud FL add to edge FL?"
        home = recipe.regions[each.region].role == "pretrain"
        return f"Does federated learning help {'in the town of pretraining, too' if home else 'where nobody learned'}?"
    own, other = (settings[arm] for arm in (MAIN, each.before_arm))
    if (own.placement.rule, other.placement.rule) == ("vrcsp", "densest"):
        return "Does the placed pole beat the pole with the densest traffic?"
    if other.placement.rule == "none" != own.placement.rule:
        return "Does the placed pole beat no pole?"
    if (own.labels[each.task], other.labels[each.task]) == ("road", "ideal-road"):
        return "What do labels of the trained road detector lose to those of an ideal one?"
    if _is_bound(own, other, each.task):
        return f"What does the run lose to its arm '{each.before_arm}', which learns from ground truth?"
    return f"Does the run beat its arm '{each.before_arm}'?"
