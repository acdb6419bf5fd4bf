"""Findings of a run: verdicts on the claims of the method, as sentences with the numbers behind them.

A claim says that a difference of a measure is positive. Its 95 % interval is a paired bootstrap over scenes, widened by
the spread of retraining. The claim held if the interval lies above 0, did not hold if it lies below, and is undecided
if the interval contains 0 or the spread is not known: another training on the same frames might say otherwise.
"""

from collections.abc import Mapping, Sequence

from flcav.pipeline.arms import Setting
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.pipeline.results.run import ArmResult
from flcav.pipeline.results.tests import Difference, Finding, Test
from flcav.verdicts import UNDECIDED, explain_verdict, signed, verdict

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
    rules = {name: setting.placement.rule for name, setting in settings.items()}
    values = {(test.arm, test.stage, test.region, test.task): test for test in tests}
    return tuple(
        _finding(each, _question(each, rules, roles), values, _tell_same_poles(each, arms, settings), caveats)
        for each in differences
        if each.arm == MAIN
    )


def _finding(
    each: Difference,
    question: str,
    values: Mapping[tuple[str, str, str, str], Test],
    same: str | None,
    caveats: Mapping[str, str],
) -> Finding:
    """Return the finding of a difference; `same`: what is said where nothing differs."""
    after = values[each.arm, each.stage, each.region, each.task].result
    before = _before(each, values).result
    place = f"{each.region}, {each.task}"
    if same is not None:
        return Finding(place, question, UNDECIDED, f"{same}: there is nothing to compare, so this run does not decide.")
    mean, low, high = each.estimate.mean, each.estimate.low, each.estimate.high
    told = (
        f"On {each.region}, {after.measure} of {each.task} was {before.estimate.mean:.3f} "
        f"({name_stage(each.before_arm, each.before_stage)}) and {after.estimate.mean:.3f} "
        f"({name_stage(each.arm, each.stage)}): {signed(mean)}"
    )
    over = f"{after.frames} test frames of {after.scenes} scenes"
    if low is None or high is None:
        return Finding(place, question, UNDECIDED, f"{told}, over {over}: too few scenes for an interval.")
    rests = f" ({caveats[each.task]})" if caveats.get(each.task) else ""
    if each.spread is None:
        unknown = "how much another training on the same frames would differ is not known, so this run does not decide"
        sentence = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {over} alone; {unknown}{rests}."
        return Finding(place, question, UNDECIDED, sentence)
    decided = verdict(low, high)
    of = f"{over} and over retraining (standard deviation {each.spread.sd:.3f} of {each.spread.trainings} trainings)"
    sentence = f"{told}, 95 % interval {signed(low)} to {signed(high)} over {of}; {explain_verdict(decided)}{rests}."
    return Finding(place, question, decided, sentence)


def _before(each: Difference, values: Mapping[tuple[str, str, str, str], Test]) -> Test:
    key = (each.before_arm, each.before_stage, each.region, each.task)
    return values.get(key) or values[MAIN, *key[1:]]


def _question(each: Difference, rules: Mapping[str, str], roles: Mapping[str, str]) -> str:
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return "Does federated learning beat pretraining alone?"
        if each.before_stage == EDGE:
            return "Does cloud FL add to edge FL?"
        where = "in the town of pretraining, too" if roles[each.region] == "pretrain" else "where nobody learned"
        return f"Does federated learning help {where}?"
    if rules[each.before_arm] == "densest" and rules[MAIN] == "vrcsp":
        return "Does the placed pole beat the pole with the densest traffic?"
    if rules[each.before_arm] == "none" and rules[MAIN] != "none":
        return "Does the placed pole beat no pole?"
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
