"""Findings of a run: verdicts on its claims, and its losses to upper bounds, with the numbers behind them.

A claim says that a difference of a measure is positive. In a run with retrainings it is judged by the mean over its
trainings, which share their test scenes. With one training the 95 % interval is a paired bootstrap over scenes, widened
by the spread of retraining, and the p-value is that of this interval. A claim held, or did not hold, if its p-value,
corrected by Holm's method, is at most 0.05. Otherwise it is undecided. Without a known spread another training on the
same frames might show the opposite, so that only a loss that is too large for any spread is decided (`tell_loss`).

A recipe may name its primary claims (`primary_claims`) before it is run. They concern means over the federating
regions, and are corrected for one another; all other claims are exploratory and corrected separately. No claim is made
that the run beats an upper bound, such as an arm with an ideal road detector: there the difference estimates the loss.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from flcav.runs.arms import Setting
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import ALL, CENTRAL, CLOUD, EDGE, ELSEWHERE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
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
OVER_PRETRAINING = "Does federated learning beat pretraining alone?"
OVER_EDGE = "Does cloud FL add to edge FL?"
NAMES = {
    PRETRAIN: "pretraining",
    EDGE: "edge FL",
    CLOUD: "cloud FL",
    CENTRAL: "central training",
    MORE_EDGE: "further edge FL",
}
BY_TASK = ("labels", "plan")  # settings whose fields are tasks
LONGEST = 60  # characters of the settings of an arm that are named; the name of others is


@dataclass(frozen=True)
class ClaimQuestion:
    """The question that a difference answers, and its kind: a claim, or an estimate of a loss."""

    question: str
    kind: Kind  # claim: one of a recipe that names no primary claims

    @property
    def named(self) -> str | None:
        """The kind "primary" or "secondary"; None for others."""
        return self.kind if self.kind in ("primary", "secondary") else None


def ask(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> ClaimQuestion:
    """Return the question that a difference of the run itself answers; `settings`: those of all arms, by name."""
    question = _question(each, recipe, settings)
    if each.before_arm != MAIN and _is_bound(settings[MAIN], settings[each.before_arm], each.task):
        return ClaimQuestion(question, "loss")
    if not recipe.primary_claims:
        return ClaimQuestion(question, "claim")
    return ClaimQuestion(question, "primary" if _name_claim(each) in recipe.primary_claims else "secondary")


def ask_all(
    differences: Sequence[Difference], recipe: RunRecipe, settings: Mapping[str, Setting]
) -> list[ClaimQuestion]:
    """Return the questions of differences; a region's is secondary if that of the mean over regions is primary."""
    joint = {pair_of(each) for each in differences if each.regions is not None}
    questions = [ask(each, recipe, settings) for each in differences]
    return [
        replace(question, kind="secondary")
        if question.kind == "primary" and each.regions is None and pair_of(each) in joint
        else question
        for each, question in zip(differences, questions, strict=True)
    ]


def pair_of(each: Difference) -> tuple[str, ...]:
    """Return the key of a difference without its region: both arms and stages, and the task."""
    return each.arm, each.stage, each.before_arm, each.before_stage, each.task


def is_joint(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> bool:
    """Return whether a primary claim concerns the mean over regions of a regional difference."""
    arms = (settings[MAIN], settings[each.before_arm])
    federating = [region for region in arms[0].regions if region in arms[1].regions]
    named = each.arm == MAIN and _name_claim(each) in recipe.primary_claims
    return named and each.regions is None and each.region in federating and len(federating) > 1


def judge_asked(asked: Sequence[ClaimQuestion], means: Sequence[MeanOverSeeds | None]) -> list[Judged | None]:
    """Return the verdicts on claims; primary ones are judged jointly, and so are the others.

    None for an estimate of a loss, and where the mean to judge is None.
    """
    found: list[Judged | None] = [None] * len(asked)
    for kind in ("claim", "primary", "secondary"):
        claims = [
            None if mean is None or each.kind != kind else Claim(mean) for each, mean in zip(asked, means, strict=True)
        ]
        found = [one or old for one, old in zip(judge_known(claims), found, strict=True)]
    return found


def _name_claim(each: Difference) -> str:
    """Return the name of a difference's claim in a recipe's `primary_claims`."""
    if each.before_arm != MAIN:
        return each.before_arm
    if each.stage == EDGE:
        return EDGE
    return CLOUD if each.before_stage == EDGE else ELSEWHERE


def _is_bound(setting: Setting, other: Setting, task: str) -> bool:
    """Return whether an arm is an upper bound of the run: it learns from truth that the run does not have."""
    first, second = (LABEL_SOURCES[each.labels[task]].bound or each.fault is not None for each in (setting, other))
    return other.central in ("federate", ALL) or (second and not first)


def _question(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting]) -> str:
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return OVER_PRETRAINING
        if each.before_stage == EDGE:
            return OVER_EDGE
        home = recipe.regions[each.region].role == "pretrain"
        return f"Does federated learning help {'in the town of pretraining, too' if home else 'where nobody learned'}?"
    main, other = (settings[arm] for arm in (MAIN, each.before_arm))
    if (main.placement.rule, other.placement.rule) == ("vrcsp", "densest"):
        return "Does the placed pole beat the pole with the densest traffic?"
    if other.placement.rule == "none" != main.placement.rule:
        return "Does the placed pole beat no pole?"
    if (main.labels[each.task], other.labels[each.task]) == ("road", "ideal-road"):
        return "What do labels of the trained road detector lose to those of an ideal one?"
    if _is_bound(main, other, each.task):
        return f"What does {NAMES[each.stage]} lose to {word_arm(main, other, recipe, each)}, an upper bound?"
    return f"Does {NAMES[each.stage]} beat {word_arm(main, other, recipe, each)}?"


def word_arm(main: Setting, other: Setting, recipe: RunRecipe, each: Difference) -> str:
    """Return what an arm is, in words: its training, its poles, its labels, or else its settings or its name."""
    if other.central == "pretrain":
        return "central training for as many steps"
    if other.central == "federate":
        return "central training on the true labels of its vehicles"
    if other.central == ALL:
        return "central training on the true labels of all towns"
    if main.placement.rule != other.placement.rule:
        poles = {"none": "no pole", "densest": "the pole with the densest traffic", "random": "a random pole"}
        if other.placement.rule in poles:
            return poles[other.placement.rule]
    if (main.labels[each.task], other.labels[each.task]) == ("road", "ideal-road"):
        return "labels of an ideal road detector"
    told = ", ".join(_list_settings(recipe.arms[other.name].model_dump(exclude_defaults=True, mode="json")))
    return f"the same with {told}" if 0 < len(told) <= LONGEST else f"the arm {other.name}"


def _list_settings(given: Mapping[str, Any], outer: str = "") -> Iterator[str]:
    """Yield the settings of an arm as "name value", without those of which stages and regions it has.

    A setting by task, such as the labels, has its name in place of the task's.
    """
    for name, value in given.items():
        if isinstance(value, Mapping) and value:
            yield from _list_settings(value, name)
        elif name not in ("stages", "regions"):
            told = outer if outer in BY_TASK else name
            listed = ", ".join(map(str, value)) if isinstance(value, list) else value
            yield told.replace("_", " ") if value in ({}, True) else f"{told.replace('_', ' ')} {listed}"


TRAINED = ("plan", "labels", "distillation", "federation", "training", "central")  # settings besides the placement


def findings(
    differences: Sequence[Difference],
    tests: Sequence[Test],
    arms: Mapping[str, ArmResult],
    settings: Mapping[str, Setting],
    recipe: RunRecipe,
    caveats: Mapping[str, str],
) -> tuple[RunFinding, ...]:
    """Return the findings from the differences of the run itself.

    `settings`: those of all arms. `caveats`: those of the labels, by task.
    """
    values = {test.key: test for test in tests}
    judged = judge_differences(differences, tests, arms, settings, recipe)
    families = Counter(each.asked.kind for each in judged)
    return tuple(
        replace(_finding(each, values, caveats, families[each.asked.kind]), kind=each.asked.named) for each in judged
    )


@dataclass(frozen=True)
class JudgedDifference:
    """A difference of the run itself with the verdict on it."""

    difference: Difference
    asked: ClaimQuestion
    judged: Judged | None  # None: an estimate of a loss, arms that do not differ, or no known spread
    same: str | None  # the sentence for arms that do not differ


def judge_differences(
    differences: Sequence[Difference],
    tests: Sequence[Test],
    arms: Mapping[str, ArmResult],
    settings: Mapping[str, Setting],
    recipe: RunRecipe,
) -> list[JudgedDifference]:
    """Return the differences of the run itself with their questions and verdicts, in the order of the findings."""
    values = {test.key: test for test in tests}
    claimed = [each for each in differences if each.arm == MAIN]
    questions = ask_all(claimed, recipe, settings)
    same = [_tell_same_poles(each, arms, settings) for each in claimed]
    means = [
        None if none_differs else _mean(each, sum(test.result.scenes for test in _after(each, values)))
        for each, none_differs in zip(claimed, same, strict=True)
    ]
    judged = judge_asked(questions, means)
    return [JudgedDifference(*row) for row in zip(claimed, questions, judged, same, strict=True)]


def _mean(each: Difference, scenes: int) -> MeanOverSeeds | None:
    """Return the number that is judged: the mean over the run's trainings, or one training of known spread."""
    if each.over_trainings is not None or each.spread is None:
        return each.over_trainings
    return of_one_training(each.over_scenes, scenes, each.spread)


def _finding(
    found: JudgedDifference,
    values: Mapping[tuple[str, str, str, str], Test],
    caveats: Mapping[str, str],
    family: int,
) -> RunFinding:
    """Return the finding of a difference, one of `family` claims."""
    compared, asked, judged, same = found.difference, found.asked, found.judged, found.same
    tests = _after(compared, values)
    measure = tests[0].result.measure
    earlier, later = (float(np.mean([test.estimate.mean for test in at])) for at in (_before(compared, values), tests))
    place = f"{compared.region}, {compared.task}"
    question = asked.question
    loss = asked.kind == "loss"
    open_, undecided = (ESTIMATE, "") if loss else (UNDECIDED, ", so the result is inconclusive")
    if same is not None:
        return RunFinding(place, question, open_, f"{same}: there is nothing to compare{undecided}.")
    mean, low, high = compared.estimate.mean, compared.estimate.low, compared.estimate.high
    trainings = "" if compared.over_trainings is None else f" in the mean of {compared.over_trainings.seeds} trainings"
    change = (
        f"On {compared.region}, {measure} of {compared.task} was {earlier:.3f} "
        f"({name_stage(compared.before_arm, compared.before_stage)}) and {later:.3f} "
        f"({name_stage(compared.arm, compared.stage)}){trainings}: {signed(mean)}"
    )
    frames, scenes = (sum(counts) for counts in zip(*((t.result.frames, t.result.scenes) for t in tests), strict=True))
    over = f"{frames} test frames of {scenes} scenes"
    if low is None or high is None:
        return RunFinding(place, question, open_, f"{change}, over {over}: too few scenes for an interval.")
    rests = f" ({caveats[compared.task]})" if caveats.get(compared.task) else ""
    if compared.spread is None or (judged is None and not loss):
        unknown = f"how much another training on the same frames would differ is not known{undecided}"
        lost = None if loss or compared.spread is not None else tell_loss(compared.over_scenes, scenes, family)
        if lost is not None:
            open_, unknown = NOT_HELD, f"{unknown.removesuffix(undecided)}, but {lost}: {explain_verdict(NOT_HELD)}"
        sentence = f"{change}, 95 % interval {signed(low)} to {signed(high)} over {over} alone; {unknown}{rests}."
        return RunFinding(place, question, open_, sentence)
    spread = compared.spread
    of = f"{over} and over retraining (standard deviation {spread.sd:.3f} of {spread.trainings} trainings)"
    text = f"{change}, 95 % interval {signed(low)} to {signed(high)} over {of}"
    if judged is None:
        return RunFinding(place, question, ESTIMATE, f"{text}: an estimate, no claim{rests}.")
    judgement = f"{judged.describe('trainings')}: {explain_verdict(judged.verdict)}"
    return RunFinding(place, question, judged.verdict, f"{text}; {judgement}{rests}.")


def _after(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> list[Test]:
    """Return the later tests of a difference, one per region."""
    return [values[each.arm, each.stage, region, each.task] for region in each.places]


def _before(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> list[Test]:
    """Return the earlier tests of a difference, one per region; arms share those of the run itself."""
    keys = [(each.before_stage, region, each.task) for region in each.places]
    return [values.get((each.before_arm, *key)) or values[MAIN, *key] for key in keys]


def _tell_same_poles(each: Difference, arms: Mapping[str, ArmResult], settings: Mapping[str, Setting]) -> str | None:
    """Describe that two arms chose the same poles, if they differ in nothing else; otherwise return None.

    Arms that differ in more than the placement may reach the same figures, too: that is a difference of 0.
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
