"""Sentences of a run, from its numbers."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from flcav.runs.analysis.caveats import list_cut, list_diverged
from flcav.runs.analysis.findings import findings
from flcav.runs.analysis.histories import gap_closed, gaps_closed
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results import tests as results
from flcav.runs.results.plans import Placed, Plan, TaskPlan
from flcav.runs.results.run import ArmResult
from flcav.runs.results.tests import Difference
from flcav.runs.results.training import StageResult, diverges
from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.seeds import SharedScenes, mean_over_seeds
from flcav.statistics.verdicts import ESTIMATE, HELD, NOT_HELD, UNDECIDED

CAVEAT = "trained road detector"
MEANS = {
    (MAIN, PRETRAIN): 0.412,
    (MAIN, EDGE): 0.503,
    (MAIN, CLOUD): 0.495,
    ("densest", EDGE): 0.544,
    ("oracle", CENTRAL): 0.612,
}


def result_of(arm: str, stage: str, mean: float) -> results.Test:
    found = results.Tested("grid", "objects", "AP50", Estimate(mean, None, None), {}, 96, 8)
    return results.Test(arm, stage, "grid", "objects", "test", found, found.estimate, None)


TESTS = [result_of(*key, mean) for key, mean in MEANS.items()]
TIED = [result_of(name, EDGE, 0.503) for name in ("random", "slow", "ideal")]


def arm(*poles: int) -> ArmResult:
    return ArmResult(Plan("joint", {}), (Placed("grid", "vrcsp", poles, 9, 3, 40.0, ()),), (), {}, ())


def difference(stage: str, before: tuple[str, str], mean: float, low: float, high: float) -> Difference:
    found = Estimate(mean, low, high)
    return Difference("", MAIN, stage, *before, "grid", "objects", found, found, Spread(0.012, 9))


def told(*differences: Difference, densest: int = 8, primary: Sequence[str] = ()):
    from test_run_recipe import parsed

    own = {
        "densest": {"placement": {"rule": "densest"}},
        "random": {"placement": {"rule": "random"}},
        "slow": {"training": {"steps": 9}},
        "ideal": {"labels": {"objects": "ideal-road"}},
    }
    recipe = parsed(arms=own, primary_claims=primary)
    settings = resolve_settings(recipe, {"objects": "road"})
    arms = {MAIN: arm(2), "densest": arm(densest), "random": arm(2), "slow": arm(2)}
    return findings(differences, TESTS + TIED, arms, settings, recipe, {"objects": CAVEAT})


def test_each_finding_tells_its_own_numbers_frames_and_verdict() -> None:
    edge, cloud, pole = told(
        difference(EDGE, (MAIN, PRETRAIN), 0.091, 0.055, 0.127),
        difference(CLOUD, (MAIN, EDGE), -0.008, -0.027, 0.012),
        difference(EDGE, ("densest", EDGE), -0.041, -0.06, -0.02),
    )
    assert [edge.verdict, cloud.verdict, pole.verdict] == [HELD, UNDECIDED, NOT_HELD]
    assert "0.412 (pretrained) and 0.503 (edge FL): +0.091, 95 % interval +0.055 to +0.127" in edge.sentence
    assert "p 0.002, corrected for 3 claims: the claim held in this run" in edge.sentence
    assert "0.503 (edge FL) and 0.495 (edge + cloud FL): −0.008" in cloud.sentence
    assert "nor any number of scenes for one training): the result is inconclusive" in cloud.sentence
    assert "0.544 (edge FL (densest)) and 0.503 (edge FL)" in pole.sentence
    assert pole.question == "Does the placed pole beat the pole with the densest traffic?"
    for finding in (edge, cloud, pole):
        assert "96 test frames of 8 scenes and over retraining (standard deviation 0.012 of 9" in finding.sentence
        assert CAVEAT in finding.sentence


def test_claims_of_a_run_are_judged_together() -> None:
    """Alone p is below 0.05 and the interval excludes 0; Holm's correction for five claims multiplies it by five."""
    one = difference(EDGE, (MAIN, PRETRAIN), 0.06, 0.022, 0.11)
    others = [difference(CLOUD, (MAIN, EDGE), 0.0, -0.02, 0.02)] * 4
    assert [each.verdict for each in told(one)] == [HELD]
    edge, *_ = told(one, *others)
    assert edge.verdict == UNDECIDED
    assert "corrected for 5 claims (0.015 alone; simultaneous interval −0." in edge.sentence
    unknown = replace(others[0], spread=None)
    assert told(one, unknown)[0].verdict == HELD, "what cannot be judged does not count"


def test_without_a_spread_of_retraining_no_claim_has_held() -> None:
    alone = replace(difference(EDGE, (MAIN, PRETRAIN), 0.091, 0.055, 0.127), spread=None)
    (edge,) = told(alone)
    assert edge.verdict == UNDECIDED
    assert "is not known, so the result is inconclusive" in edge.sentence


def test_a_collapse_is_a_loss_whatever_the_spread_of_retraining() -> None:
    collapse = replace(difference(EDGE, (MAIN, PRETRAIN), -0.734, -0.906, -0.547), spread=None)
    gain = replace(difference(EDGE, (MAIN, PRETRAIN), 0.734, 0.547, 0.906), spread=None)
    known = difference(EDGE, (MAIN, PRETRAIN), 0.06, 0.022, 0.11)
    lost, gained, other = told(collapse, gain, known)
    assert (lost.verdict, gained.verdict) == (NOT_HELD, UNDECIDED)
    assert "is not known, but a spread of 0.1, above any measured, would not explain such a loss" in lost.sentence
    assert "(p < 0.001, corrected for 3 claims): the claim did not hold in this run" in lost.sentence
    assert other == told(known)[0], "claims of known spread are corrected for one another alone"


def test_a_run_with_retrainings_is_judged_by_the_mean_of_its_trainings() -> None:
    """The first training alone says the opposite; with as much spread from a table it would decide nothing."""
    values = [-0.01, 0.05, 0.04, 0.06, 0.05, 0.03, 0.04, 0.06]
    mean = mean_over_seeds(values, shared=SharedScenes(0.006, 30))
    first = difference(EDGE, (MAIN, PRETRAIN), values[0], -0.022, 0.002)
    (edge,) = told(replace(first, estimate=mean.as_estimate(), retrained=tuple(values[1:]), over_trainings=mean))
    assert edge.verdict == HELD
    assert "(edge FL) in the mean of 8 trainings: +0.040, 95 % interval +0.0" in edge.sentence
    p_value = mean.p_value()
    assert p_value is not None
    assert f"p {p_value:.3f}: the claim held" in edge.sentence
    assert [each.verdict for each in told(first)] == [UNDECIDED]


def test_a_densest_pole_that_was_chosen_leaves_nothing_to_compare() -> None:
    (pole,) = told(difference(EDGE, ("densest", EDGE), 0.0, 0.0, 0.0), densest=2)
    assert pole.verdict == UNDECIDED
    assert pole.sentence.startswith(
        "Pole 2, placed by VRCSP, is also where traffic is densest: there is nothing to comp"
    )


def test_other_rules_that_choose_the_same_pole_leave_nothing_to_compare_and_another_training_a_tie() -> None:
    random, slow = told(*(difference(EDGE, (name, EDGE), 0.0, 0.0, 0.0) for name in ("random", "slow")))
    assert random.verdict == slow.verdict == UNDECIDED
    assert random.sentence.startswith("Pole 2 has a sensor in both arms: there is nothing to compare")
    assert "0.503 (edge FL (slow)) and 0.503 (edge FL): +0.000, 95 % interval +0.000 to +0.000" in slow.sentence
    assert "pole" not in slow.sentence


def test_what_a_trained_road_detector_loses_to_an_ideal_one_is_no_claim_and_corrects_none() -> None:
    one, lost = (
        difference(EDGE, (MAIN, PRETRAIN), 0.06, 0.022, 0.11),
        difference(EDGE, ("ideal", EDGE), -0.03, -0.04, -0.02),
    )
    edge, *others = told(one, *[lost] * 4)
    assert edge == told(one)[0]
    for ideal in others:
        assert ideal.question == "What do labels of the trained road detector lose to those of an ideal one?"
        assert ideal.verdict == ESTIMATE
        assert "−0.030, 95 % interval −0.040 to −0.020" in ideal.sentence
        assert ideal.sentence.endswith(f"of 9 trainings): an estimate, no claim ({CAVEAT}).")
    (unknown,) = told(replace(lost, spread=None))
    assert unknown.verdict == ESTIMATE
    assert "decide" not in unknown.sentence


def test_primary_claims_are_corrected_apart_from_others() -> None:
    one, other = (
        difference(EDGE, (MAIN, PRETRAIN), 0.06, 0.022, 0.11),
        difference(CLOUD, (MAIN, EDGE), 0.0, -0.02, 0.02),
    )
    pole = difference(EDGE, ("densest", EDGE), -0.041, -0.06, -0.02)
    edge, cloud, again, densest = told(one, other, other, pole, primary=["edge", "densest"])
    assert [each.decision for each in (edge, cloud)] == ["held, primary claim", "undecided, secondary claim"]
    assert (again.kind, densest.kind) == ("secondary", "primary")
    assert "corrected for 2 claims" in edge.sentence
    assert "corrected for 2 claims" in cloud.sentence
    assert told(one, other, other, pole)[0].verdict == UNDECIDED, "without primary claims all are corrected together"
    cloud_alone = told(one, other, primary=["cloud"])
    assert [each.kind for each in cloud_alone] == ["secondary", "primary"]
    assert "p 0.015: the claim held" in cloud_alone[0].sentence
    (elsewhere,) = told(difference(CLOUD, (MAIN, PRETRAIN), 0.06, 0.022, 0.11), primary=["elsewhere"])
    assert elsewhere.kind == "primary"


def test_one_scene_decides_nothing() -> None:
    alone = replace(difference(EDGE, (MAIN, PRETRAIN), 0.1, 0.0, 0.0), estimate=Estimate(0.1, None, None))
    (edge,) = told(alone)
    assert edge.verdict == UNDECIDED
    assert "too few scenes" in edge.sentence


def test_the_gap_is_the_way_from_pretraining_to_ground_truth() -> None:
    assert gap_closed(0.4, 0.5, 0.6) == pytest.approx(0.5)
    assert gap_closed(0.4, 0.6, 0.6) == pytest.approx(1.0)
    assert gap_closed(0.4, 0.3, 0.6) == pytest.approx(-0.5)


def test_gaps_are_closed_of_every_stage_where_there_is_an_oracle() -> None:
    from test_run_recipe import parsed

    recipe = parsed(arms={"densest": {}, "oracle": {"central": "federate"}})
    closed = gaps_closed(TESTS, recipe)
    assert closed["grid, objects: edge FL"] == pytest.approx((0.503 - 0.412) / (0.612 - 0.412))
    assert closed["grid, objects: edge FL (densest)"] == pytest.approx((0.544 - 0.412) / 0.2)
    assert set(closed) == {
        "grid, objects: edge FL",
        "grid, objects: edge + cloud FL",
        "grid, objects: edge FL (densest)",
    }
    assert gaps_closed(TESTS, parsed()) == {}


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        ((), False),
        ((None,), False),
        ((0.5, 0.4, 0.6), False),
        ((0.001, 0.5), False),
        ((0.5, 1254.0), True),
        ((0.5, None, 1254.0, None), True),
        ((0.5, 1254.0, 0.4), False),
        ((20.0, 150.0), False),
        ((20.0, 250.0), True),
        ((0.5, math.nan), True),
        ((math.inf,), True),
    ],
)
def test_a_training_diverges_where_its_loss_is_far_above_the_first(losses: Sequence[float | None], expected: bool):
    assert diverges(losses) is expected


def test_a_training_that_stopped_is_told_and_not_laid_on_the_privacy_budget() -> None:
    from test_run_recipe import parsed

    about: Any = {"task": "objects", "samples": 9, "clients": 3, "poles": ()}
    stopped = StageResult(EDGE, region="grid", rounds=4, losses=(0.8, 0.7, 0.6, 2945961.0), kept=2, **about)
    left_out = StageResult(CLOUD, region=None, rounds=0, **about)
    own = TaskPlan(320, 6, 3, 216.0, 128.1, 0.37, 1.35, {})
    ruined = {MAIN: replace(arm(), plan=Plan("joint", {"objects": own}), stages=(stopped, left_out))}
    assert list_diverged(ruined) == (
        "the training diverged: objects in stage II of 'main' on grid, its loss went from 0.8 to 2.95e+06; it stopped "
        "in round 4, and has the weights after round 2; no rounds follow",
    )
    settings = resolve_settings(parsed(federation={"privacy": {"epsilon": 8}}), {"objects": "road"})
    assert list_cut(ruined, settings) == ()
    short = replace(stopped, losses=(0.8,) * 4, kept=None)
    assert list_diverged({MAIN: replace(ruined[MAIN], stages=(short, left_out))}) == ()
    assert len(list_cut({MAIN: replace(ruined[MAIN], stages=(short, left_out))}, settings)) == 2
