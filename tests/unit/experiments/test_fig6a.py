from dataclasses import replace

import numpy as np
import pytest

from flcav.config import InputError
from flcav.report.charts.plans import predicted_and_realised
from flcav.reproductions.fig6a_allocation.findings import (
    EQUAL,
    JOINT,
    MEAN,
    AllocationResult,
    AllocationSeed,
    AtBudgets,
    Planned,
    StageAP,
    allocation_findings,
)
from flcav.reproductions.fig6a_allocation.run import (
    BUDGETS,
    PLANS,
    STAGES,
    _collect,
    budget_recipes,
    draw_allocation,
    summarise,
    tables,
)
from flcav.runs.provenance import provenance
from flcav.runs.recipe import load_run_recipe
from flcav.runs.results.plans import Placed, Pole
from flcav.runs.results.run import LinkUse
from flcav.sources.recipe import recipe_path
from flcav.statistics.estimates import Estimate

TOWNS = (MEAN, "grid", "ring")
PREDICTED = {EQUAL: (0.49, 0.60, 0.62), JOINT: (0.53, 0.63, 0.66)}
HISTORY = {"samples": (80.0, 320.0), "edge_rounds": (0.0, 6.0), "cloud_rounds": (0.0, 3.0)}


def seed_of(number: int, equal: tuple[float, ...], joint: tuple[float, ...]) -> AllocationSeed:
    """Return what one seed reached: AP50 after each stage with either plan."""
    reached = {EQUAL: equal, JOINT: joint}
    realised = {name: {str(s): StageAP(ap) for s, ap in zip(STAGES, aps)} for name, aps in reached.items()}
    differences = {s: Estimate(b - a, b - a - 0.05, b - a + 0.05) for s, a, b in zip(STAGES, equal, joint)}
    plan = Planned(118, 6, 6, 175.0, 70.0, predicted_error=0.38)
    book = {"wireless": LinkUse(180.0, 175.0, 176.0), "wireline": LinkUse(110.0, 70.0, 69.5)}
    return AllocationSeed(
        seed=number,
        plans={EQUAL: plan, JOINT: replace(plan, edge_rounds=12, cloud_rounds=1)},
        predicted={name: dict(zip(STAGES, aps)) for name, aps in PREDICTED.items()},
        realised=dict.fromkeys(TOWNS, realised),
        differences=dict.fromkeys(TOWNS, differences),
        poles={name: {"grid": 3, "ring": 5} for name in PLANS},
        ledger=dict.fromkeys(PLANS, book),
    )


def results_of(*seeds: tuple[tuple[float, ...], tuple[float, ...]]) -> AtBudgets:
    rows = tuple(seed_of(number, *aps) for number, aps in enumerate(seeds, start=1))
    results = AtBudgets(1.0, rows, summarise(rows))
    return replace(results, findings=allocation_findings([results], HISTORY)[0])


RIGHT = results_of(
    ((0.48, 0.58, 0.60), (0.52, 0.62, 0.65)),
    ((0.50, 0.60, 0.61), (0.53, 0.64, 0.67)),
    ((0.49, 0.59, 0.63), (0.52, 0.63, 0.68)),
)
WRONG = results_of(
    ((0.48, 0.58, 0.60), (0.52, 0.55, 0.56)),
    ((0.50, 0.60, 0.61), (0.53, 0.56, 0.57)),
    ((0.49, 0.59, 0.63), (0.52, 0.56, 0.58)),
)


def verdicts(results: AtBudgets) -> list[str]:
    return [finding.verdict for finding in results.findings]


def test_a_region_without_a_sensor_is_named() -> None:
    nothing = Placed("ring", "vrcsp", (), errors=0, covered=0, range_m=30.0, poles=(Pole(3, 0, 1.5),))
    with pytest.raises(
        InputError, match=r"region 'ring': no sensor was placed \(candidate poles: 1, errors to cover: 0\)"
    ):
        _ = nothing.first
    assert replace(nothing, chosen=(3, 5)).first == 3


def test_differences_are_paired_by_seed() -> None:
    found = RIGHT.summary.realised_difference[MEAN]["cloud"]
    assert found.mean == pytest.approx(np.mean([0.05, 0.06, 0.05]))
    assert found.low == pytest.approx(found.mean - 4.302653 * np.std([0.05, 0.06, 0.05], ddof=1) / np.sqrt(3))
    assert RIGHT.summary.predicted_difference["cloud"] == pytest.approx(0.04)


def test_a_prediction_that_came_true_is_said_to_have_held() -> None:
    assert verdicts(RIGHT) == ["held", "held", "undecided", "held", "held"]
    better, ranking, stages, accuracy, budgets = (finding.sentence for finding in RIGHT.findings)
    assert "0.613 with equal stages and 0.667 with the joint plan: +0.053" in better
    assert "predicts +0.040 for the joint plan; 3 of 3 seeds agree in sign, and so does their mean" in ranking
    assert "edge FL of the joint plan (12 rounds) +0.107 (+0.092 to +0.121)" in stages
    assert "off its prediction by 0.013 (0.006 to 0.021) on average" in accuracy
    assert "where 0.040 are predicted to lie between the plans; p 0." in accuracy
    assert "within its budgets, at 63% to 98%" in budgets
    assert "−0.50 to +1.00 MB" in budgets


def test_a_wrong_ranking_is_said_and_why() -> None:
    better, ranking, *_ = WRONG.findings
    assert (better.verdict, ranking.verdict) == ("did not hold", "did not hold")
    assert "0 of 3 seeds agree in sign, and their mean does not. They part most in edge FL" in ranking.sentence
    assert "was to have −0.010 more than equal stages, and had −0.067" in ranking.sentence
    assert "extrapolated for edge rounds 12 of the joint plan (history: 0 to 6)" in ranking.sentence


def test_a_stage_that_costs_accuracy_is_said_beside_what_it_brought_elsewhere() -> None:
    rows = [((0.48, 0.58, 0.60), (0.52, 0.62, ap)) for ap in (0.58, 0.585, 0.59)]
    stages = results_of(*rows).findings[2]
    assert stages.verdict == "did not hold"
    assert "cloud FL of the joint plan (1 round) −0.035 (−0.047 to −0.023)" in stages.sentence
    assert "The curve predicted +0.030 for cloud FL of the joint plan." in stages.sentence
    assert "on ring the same stage brought −0.035" in stages.sentence
    assert results_of(rows[0]).findings[2].verdict == "undecided"


def test_seeds_that_disagree_decide_nothing() -> None:
    mixed = results_of(((0.48, 0.58, 0.60), (0.5, 0.6, 0.65)), ((0.5, 0.6, 0.65), (0.5, 0.6, 0.63)))
    assert verdicts(mixed)[:2] == ["undecided", "undecided"]
    assert "1 of 2 seeds agree in sign, and so does their mean, but that is undecided" in mixed.findings[1].sentence
    assert "corrected for 6 claims; detecting an effect of this size takes about 136 seeds" in (
        mixed.findings[0].sentence
    )
    assert "Detecting the predicted difference of +0.040 takes 23 seeds" in mixed.findings[0].sentence


def test_one_seed_is_judged_by_its_scenes() -> None:
    single = results_of(((0.48, 0.58, 0.60), (0.5, 0.6, 0.63)))
    sentence = single.findings[0].sentence
    assert "over test scenes of one seed, in which training does not vary" in sentence
    assert single.findings[0].verdict == "undecided"


def test_a_budget_that_was_exceeded_is_said() -> None:
    first, *others = RIGHT.seeds
    own = first.ledger[JOINT]
    above = {**own, "wireline": replace(own["wireline"], used_mb=111.0)}
    broken = replace(RIGHT, seeds=(replace(first, ledger={**first.ledger, JOINT: above}), *others))
    found = allocation_findings([broken], HISTORY)[0][-1]
    assert found.verdict == "did not hold"
    assert "above its budgets" in found.sentence


def test_claims_under_several_budgets_are_corrected_together() -> None:
    both = allocation_findings([RIGHT, replace(WRONG, factor=4.0)], HISTORY)
    assert [own[0].verdict for own in both] == ["held", "did not hold"]
    assert all("corrected for 12 claims" in own[2].sentence for own in both)


def test_plans_that_coincide_are_told_and_not_judged() -> None:
    same = [replace(seed, plans=dict.fromkeys(PLANS, seed.plans[JOINT])) for seed in RIGHT.seeds]
    both = allocation_findings([WRONG, replace(RIGHT, factor=4.0, seeds=(same[0],))], HISTORY)
    assert "corrected for 6 claims" in both[0][2].sentence
    told, budgets = both[1]
    assert told.verdict == "undecided"
    assert "the same, 118 samples, 12 edge rounds, 1 cloud rounds" in told.sentence
    assert "0.667 after cloud FL (predicted: 0.660)" in told.sentence
    assert budgets.verdict == "held"
    assert not replace(RIGHT, seeds=(same[0], RIGHT.seeds[1])).coincide


def test_budgets_are_multiples_of_the_recipe_s() -> None:
    recipe = load_run_recipe(recipe_path("runs/allocation"))
    found = budget_recipes(recipe, (1, 2))
    assert list(found) == [f"x{factor:g}-seed{seed}" for factor in BUDGETS for seed in (1, 2)]
    asked = found["x0.25-seed2"]
    assert (asked.seed, asked.budgets_mb.wireless, asked.budgets_mb.wireline) == (
        2,
        0.25 * recipe.budgets_mb.wireless,
        0.25 * recipe.budgets_mb.wireline,
    )
    assert found["x1-seed1"] == recipe


def test_tables_hold_a_row_per_run() -> None:
    found = tables(AllocationResult(HISTORY, (replace(WRONG, factor=0.25), RIGHT), {}, provenance()))
    assert found["plans"].count("\n") == 1 + 12
    assert "| x 1 | 1 | joint | 118 | 12 | 1 | 0.620 | 3 / 5 |" in found["plans"]
    assert "| x 1 | cloud FL | joint | 0.660 | 0.667 (" in found["accuracy"]
    assert "| x 1 | mean of towns | cloud FL | +0.040 | +0.053 (" in found["differences"]
    assert "| x 0.25 | 2 | joint | wireline | 110.0 | 70.0 | 69.5 | -0.50 |" in found["megabytes"]
    assert found["findings"].count("\n- ") == 9


def test_the_picture_has_a_row_per_budgets() -> None:
    results = AllocationResult(HISTORY, (replace(WRONG, factor=0.25), RIGHT), {}, provenance())
    assert draw_allocation(results).startswith(b"\x89PNG")
    collected = {each.name: _collect(each) for each in results.budgets}
    titles = [axes.get_title(loc="left") for axes in predicted_and_realised(collected, MEAN).axes]
    assert titles[::2] == ["budgets x 0.25: AP50, mean of towns", "budgets x 1: AP50, mean of towns"]
