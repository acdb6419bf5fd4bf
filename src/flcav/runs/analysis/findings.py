"""Findings of a run: verdicts on its claims, and what it loses to upper bounds, with the numbers behind them.

A claim says that a difference of a measure is positive. Of a run with retrainings it is judged by the mean over its
trainings, which share their test scenes. Of one training the 95 % interval is a paired bootstrap over scenes, widened
by the spread of retraining, and the p-value is that of this interval. A claim held, or did not hold, if its corrected
p-value (Holm) is at most 0.05. It is undecided else, and where the spread is not known: another training on the same
frames might say otherwise. Only a loss that is too large for any spread is one without it (`tell_loss`).

A recipe may name its primary claims (`primary_claims`) before it is run. Each is of the mean over the regions that
federate. They are corrected for one another, and all others, exploratory ones, apart from them. Nobody claims that the
run beats an upper bound, such as an arm with an ideal road detector: there the difference is an estimate of what is
lost.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from flcav.runs.arms import Setting
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import ALL, CLOUD, EDGE, ELSEWHERE, MAIN, RunRecipe
from flcav.runs.results.run import ArmResult
from flcav.runs.results.tests import Difference, RunFinding, Test, name_stage
from flcav.statistics.seeds import MeanOverSeeds, of_one_training
from flcav.statistics.verdicts import (
    ESTIMATE,
    NOT_HELD,
    UNDECIDED,
    Claim,
    Judged,
    explain_verdict,
    judge_known,
    signed,
    tell_loss,
)

Kind = Literal["claim", "primary", "secondary", "loss"]


@dataclass(frozen=True)
class ClaimQuestion:
    """The question that a difference answers, and what it is to the run: a claim, or an estimate of a loss."""

    question: str
    kind: Kind  # claim: one of a recipe that names no primary claims

    @property
    def named(self) -> str | None:
        """Return "primary" or "secondary"; None for other kinds."""
        return self.kind if self.kind in ("primary", "secondary") else None


def ask(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> ClaimQuestion:
    """Return the question that a difference of the run itself answers; `settings`: those of each arm, by name."""
    question = _question(each, recipe, settings)
    if each.before_arm != MAIN and _is_bound(settings[MAIN], settings[each.before_arm], each.task):
        return ClaimQuestion(question, "loss")
    if not recipe.primary_claims:
        return ClaimQuestion(question, "claim")
    return ClaimQuestion(question, "primary" if _name_claim(each) in recipe.primary_claims else "secondary")


def ask_all(
    differences: Sequence[Difference], recipe: RunRecipe, settings: Mapping[str, Setting]
) -> list[ClaimQuestion]:
    """Return the question of each difference; a region's is secondary if the mean over regions is primary."""
    joint = {pair_of(each) for each in differences if each.regions is not None}
    asked = [ask(each, recipe, settings) for each in differences]
    return [
        replace(own, kind="secondary")
        if own.kind == "primary" and each.regions is None and pair_of(each) in joint
        else own
        for each, own in zip(differences, asked, strict=True)
    ]


def pair_of(each: Difference) -> tuple[str, ...]:
    """Return both arms and stages and the task of a difference, without its region."""
    return each.arm, each.stage, each.before_arm, each.before_stage, each.task


def is_joint(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> bool:
    """Return whether a primary claim is of the mean over regions of this difference, which is that of one of them."""
    arms = (settings[MAIN], settings[each.before_arm])
    federating = [region for region in arms[0].regions if region in arms[1].regions]
    named = each.arm == MAIN and _name_claim(each) in recipe.primary_claims
    return named and each.regions is None and each.region in federating and len(federating) > 1


def judge_asked(asked: Sequence[ClaimQuestion], means: Sequence[MeanOverSeeds | None]) -> list[Judged | None]:
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
    first, second = (LABEL_SOURCES[each.labels[task]].bound or each.fault is not None for each in (own, other))
    return other.central in ("federate", ALL) or (second and not first)


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


TRAINED = ("plan", "labels", "distillation", "federation", "training", "central")  # settings besides the placement


def findings(
    differences: Sequence[Difference],
    tests: Sequence[Test],
    arms: Mapping[str, ArmResult],
    settings: Mapping[str, Setting],
    recipe: RunRecipe,
    caveats: Mapping[str, str],
) -> tuple[RunFinding, ...]:
    """Return a finding for each difference of the run itself.

    `settings`: those of each arm. `caveats`: those of the labels, by task.
    """
    values = {test.key: test for test in tests}
    own = [each for each in differences if each.arm == MAIN]
    asked = ask_all(own, recipe, settings)
    same = [_tell_same_poles(each, arms, settings) for each in own]
    means = [
        None if none_differs else _mean(each, sum(test.result.scenes for test in _after(each, values)))
        for each, none_differs in zip(own, same, strict=True)
    ]
    families = Counter(about.kind for about in asked)
    return tuple(
        replace(_finding(each, judged, about, values, none_differs, caveats, families[about.kind]), kind=about.named)
        for each, judged, about, none_differs in zip(own, judge_asked(asked, means), asked, same, strict=True)
    )


def _mean(each: Difference, scenes: int) -> MeanOverSeeds | None:
    """Return the number that is judged: the mean over the run's trainings, or one training of known spread."""
    if each.over_trainings is not None or each.spread is None:
        return each.over_trainings
    return of_one_training(each.over_scenes, scenes, each.spread)


def _finding(
    each: Difference,
    judged: Judged | None,
    asked: ClaimQuestion,
    values: Mapping[tuple[str, str, str, str], Test],
    same: str | None,
    caveats: Mapping[str, str],
    family: int,
) -> RunFinding:
    """Return the finding of a difference, one of `family` claims; `same`: what is said where nothing differs."""
    tests, measure = _after(each, values), _after(each, values)[0].result.measure
    earlier, later = (float(np.mean([test.estimate.mean for test in own])) for own in (_before(each, values), tests))
    place, question = f"{each.region}, {each.task}", asked.question
    loss = asked.kind == "loss"
    open_, undecided = (ESTIMATE, "") if loss else (UNDECIDED, ", so the result is inconclusive")
    if same is not None:
        return RunFinding(place, question, open_, f"{same}: there is nothing to compare{undecided}.")
    mean, low, high = each.estimate.mean, each.estimate.low, each.estimate.high
    trainings = "" if each.over_trainings is None else f" in the mean of {each.over_trainings.seeds} trainings"
    told = (
        f"On {each.region}, {measure} of {each.task} was {earlier:.3f} "
        f"({name_stage(each.before_arm, each.before_stage)}) and {later:.3f} "
        f"({name_stage(each.arm, each.stage)}){trainings}: {signed(mean)}"
    )
    frames, scenes = (sum(counts) for counts in zip(*((t.result.frames, t.result.scenes) for t in tests), strict=True))
    over = f"{frames} test frames of {scenes} scenes"
    if low is None or high is None:
        return RunFinding(place, question, open_, f"{told}, over {over}: too few scenes for an interval.")
    rests = f" ({caveats[each.task]})" if caveats.get(each.task) else ""
    if each.spread is None or (judged is None and not loss):
        unknown = f"how much another training on the same frames would differ is not known{undecided}"
        lost = None if loss or each.spread is not None else tell_loss(each.over_scenes, scenes, family)
        if lost is not None:
            open_, unknown = NOT_HELD, f"{unknown.removesuffix(undecided)}, but {lost}: {explain_verdict(NOT_HELD)}"
        sentence = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {over} alone; {unknown}{rests}."
        return RunFinding(place, question, open_, sentence)
    of = f"{over} and over retraining (standard deviation {each.spread.sd:.3f} of {each.spread.trainings} trainings)"
    found = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {of}"
    if judged is None:
        return RunFinding(place, question, ESTIMATE, f"{found}: an estimate, no claim{rests}.")
    said = f"{judged.describe('trainings')}: {explain_verdict(judged.verdict)}"
    return RunFinding(place, question, judged.verdict, f"{found}; {said}{rests}.")


def _after(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> list[Test]:
    """Return the later tests of a difference, one per region."""
    return [values[each.arm, each.stage, region, each.task] for region in each.places]


def _before(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> list[Test]:
    """Return the earlier tests of a difference, one per region; arms share those of the run itself."""
    keys = [(each.before_stage, region, each.task) for region in each.places]
    return [values.get((each.before_arm, *key)) or values[MAIN, *key] for key in keys]


def _tell_same_poles(each: Difference, arms: Mapping[str, ArmResult], settings: Mapping[str, Setting]) -> str | None:
    """Describe that two arms chose the same poles, if that is why nothing differs; else return None.

    Arms that differ in more than the placement may come to the same figures, too: that is a difference of 0.
    """
    ours, other = settings[each.arm], settings[each.before_arm]
    if each.before_arm == MAIN or each.stage != each.before_stage:
        return None
    if any(getattr(ours, name) != getattr(other, name) for name in TRAINED):
        return None
    if each.estimate.mean or each.estimate.low or each.estimate.high:
        return None
    chosen, others = (
        next((placed.chosen for placed in arms[arm].placed if placed.region == each.region), ())
        for arm in (each.arm, each.before_arm)
    )
    if not chosen or set(chosen) != set(others):
        return None
    poles = f"Pole {chosen[0]}" if len(chosen) == 1 else f"Each of the poles {', '.join(map(str, chosen))}"
    if (ours.placement.rule, other.placement.rule) == ("vrcsp", "densest"):
        return f"{poles}, placed by VRCSP, is also where traffic is densest"
    return f"{poles} has a sensor in both arms"
