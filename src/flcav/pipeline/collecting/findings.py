"""Findings of a run: verdicts on the claims of the method, as sentences with the numbers behind them.

A claim says that a difference of a measure is positive. Of a run with retrainings it is judged by the mean over its
trainings, which share their test scenes. Of one training the 95 % interval is a paired bootstrap over scenes, widened
by the spread of retraining, and the p-value is that of this interval. P-values of a run are corrected together (Holm).
A claim held, or did not hold, if its corrected p-value is at most 0.05. It is undecided else, and where the spread is
not known: another training on the same frames might say otherwise.
"""

from collections.abc import Mapping, Sequence

from flcav.intervals import MeanOverSeeds, of_one_training
from flcav.pipeline.arms import Setting
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.pipeline.results.run import ArmResult
from flcav.pipeline.results.tests import Difference, Finding, Test
from flcav.verdicts import UNDECIDED, Claim, Judged, explain_verdict, judge_known, signed

WORDS = {
    PRETRAIN: "pretrained",
    EDGE: "edge FL",
    MORE_EDGE: "further edge FL",
    CLOUD: "edge + cloud FL",
    CENTRAL: "central training",
}

TRAINED = ("plan", "labels", "distillation", "federation", "training", "central")  # settings besides the placement


def name_stage(arm: str, stage: str) -> str:
    """Return the name of an arm's stage in reports, such as "edge FL (densest)"."""
    return WORDS[stage] if arm == MAIN else f"{WORDS[stage]} ({arm})"


def findings(
    differences: Sequence[Difference],
    tests: Sequence[Test],
    arms: Mapping[str, ArmResult],
    settings: Mapping[str, Setting],
    roles: Mapping[str, str],
    caveats: Mapping[str, str],
) -> tuple[Finding, ...]:
    """Return a finding for each difference of the run itself.

    `settings`: those of each arm. `roles`: role of each region. `caveats`: those of the labels, by task.
    """
    values = {(test.arm, test.stage, test.region, test.task): test for test in tests}
    own = [each for each in differences if each.arm == MAIN]
    same = [_tell_same_poles(each, arms, settings) for each in own]
    return tuple(
        _finding(each, judged, _question(each, settings, roles), values, none_differs, caveats)
        for each, judged, none_differs in zip(own, _judge(own, values, same), same, strict=True)
    )


def _judge(
    differences: Sequence[Difference], values: Mapping[tuple[str, str, str, str], Test], same: Sequence[str | None]
) -> list[Judged | None]:
    """Return the verdicts on all differences, judged together; None where the spread of retraining is not known.

    `same`: what is said of each difference where nothing differs, which is not judged.
    """
    means = [
        None if none_differs else _mean(each, values[each.arm, each.stage, each.region, each.task].result.scenes)
        for each, none_differs in zip(differences, same, strict=True)
    ]
    return judge_known([None if mean is None else Claim(mean) for mean in means])


def _mean(each: Difference, scenes: int) -> MeanOverSeeds | None:
    """Return the number that is judged: the mean over the run's trainings, or one training of known spread."""
    if each.over_trainings is not None or each.spread is None:
        return each.over_trainings
    return of_one_training(each.over_scenes, scenes, each.spread)


def _finding(
    each: Difference,
    judged: Judged | None,
    question: str,
    values: Mapping[tuple[str, str, str, str], Test],
    same: str | None,
    caveats: Mapping[str, str],
) -> Finding:
    """Return the finding of a difference; `same`: what is said where nothing differs."""
    test, before = values[each.arm, each.stage, each.region, each.task], _before(each, values)
    after = test.result
    place = f"{each.region}, {each.task}"
    if same is not None:
        return Finding(place, question, UNDECIDED, f"{same}: there is nothing to compare, so this run does not decide.")
    mean, low, high = each.estimate.mean, each.estimate.low, each.estimate.high
    told = (
        f"On {each.region}, {after.measure} of {each.task} was {before.estimate.mean:.3f} "
        f"({name_stage(each.before_arm, each.before_stage)}) and {test.estimate.mean:.3f} "
        f"({name_stage(each.arm, each.stage)}){_tell_trainings(each)}: {signed(mean)}"
    )
    over = f"{after.frames} test frames of {after.scenes} scenes"
    if low is None or high is None:
        return Finding(place, question, UNDECIDED, f"{told}, over {over}: too few scenes for an interval.")
    rests = f" ({caveats[each.task]})" if caveats.get(each.task) else ""
    if each.spread is None or judged is None:
        unknown = "how much another training on the same frames would differ is not known, so this run does not decide"
        sentence = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {over} alone; {unknown}{rests}."
        return Finding(place, question, UNDECIDED, sentence)
    of = f"{over} and over retraining (standard deviation {each.spread.sd:.3f} of {each.spread.trainings} trainings)"
    said = f"{judged.describe('trainings on these scenes')}: {explain_verdict(judged.verdict)}"
    sentence = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {of}; {said}{rests}."
    return Finding(place, question, judged.verdict, sentence)


def _tell_trainings(each: Difference) -> str:
    return "" if each.over_trainings is None else f" in the mean of {each.over_trainings.seeds} trainings"


def _before(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> Test:
    key = (each.before_arm, each.before_stage, each.region, each.task)
    return values.get(key) or values[MAIN, *key[1:]]


def _question(each: Difference, settings: Mapping[str, Setting], roles: Mapping[str, str]) -> str:
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return "Does federated learning beat pretraining alone?"
        if each.before_stage == EDGE:
            return "Does cloud FL add to edge FL?"
        where = "in the town of pretraining, too" if roles[each.region] == "pretrain" else "where nobody learned"
        return f"Does federated learning help {where}?"
    own, other = (settings[arm] for arm in (MAIN, each.before_arm))
    if (own.placement.rule, other.placement.rule) == ("vrcsp", "densest"):
        return "Does the placed pole beat the pole with the densest traffic?"
    if other.placement.rule == "none" != own.placement.rule:
        return "Does the placed pole beat no pole?"
    if (own.labels[each.task], other.labels[each.task]) == ("road", "ideal-road"):
        return "Do labels of the trained road detector beat those of an ideal one?"
    return f"Does the run beat its arm '{each.before_arm}'?"


def _tell_same_poles(each: Difference, arms: Mapping[str, ArmResult], settings: Mapping[str, Setting]) -> str | None:
    """Return that two arms chose the same poles, in words, where that is why nothing differs; else None.

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
