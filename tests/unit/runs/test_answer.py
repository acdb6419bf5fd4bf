"""The answer to the title of a run's report follows from its verdicts."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.report.pages.html import render
from flcav.report.pages.run_page import page
from flcav.runs.analysis.answer import list_stage_means, tell_answer
from flcav.runs.analysis.claims import list_claims
from flcav.runs.analysis.tiles import list_tiles
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN
from flcav.runs.results.run import Run
from flcav.runs.results.tests import FoundCount
from flcav.runs.running import RESULTS
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED

RUNS = Path(__file__).parents[3] / "reproductions" / "runs"
QUESTION = "Does federated learning beat pretraining alone?"


def judged(run: Run, *verdicts: str) -> Run:
    """Return the run with these verdicts on edge FL against pretraining, in order; the last one for all others."""
    left = [*verdicts]
    findings = [
        replace(each, verdict=left.pop(0) if len(left) > 1 else left[0]) if each.question == QUESTION else each
        for each in run.findings
    ]
    return replace(run, findings=tuple(findings))


@pytest.mark.parametrize(
    ("verdicts", "word"),
    [
        ((HELD,), "Yes, at a price"),
        ((NOT_HELD,), "No"),
        ((UNDECIDED,), "This run cannot tell"),
        ((HELD, NOT_HELD), "Yes, at a price"),  # that on the mean over regions is the first
        ((NOT_HELD, HELD), "No"),
    ],
)
def test_the_word_is_that_of_the_verdict_on_the_mean_over_regions(verdicts: tuple[str, ...], word: str) -> None:
    run = judged(Run.load(RUNS / "demo/earlier/float32", RESULTS), *verdicts)
    answer = tell_answer(run)
    assert answer is not None
    assert answer.word == word
    told = render(page(run), {})
    assert f"<b>{word}.</b> In two unseen towns: AP50 of objects" in told
    assert f'<span class="badge {verdicts[0].replace(" ", "-")}">{verdicts[0]}</span>' in told[: told.index("<nav>")]


@pytest.mark.parametrize(
    ("verdicts", "word"),
    [
        ((HELD, HELD), "Yes, at a price"),
        ((HELD, NOT_HELD), "In part, at a price"),
        ((UNDECIDED, HELD), "In part, at a price"),
        ((NOT_HELD, UNDECIDED), "This run cannot tell"),
        ((NOT_HELD, NOT_HELD), "No"),
    ],
)
def test_without_one_all_regions_count(verdicts: tuple[str, ...], word: str) -> None:
    answer = tell_answer(judged(Run.load(RUNS / "demo/earlier/retraining", RESULTS), *verdicts))
    assert answer is not None
    assert answer.word == word
    run = judged(Run.load(RUNS / "demo/earlier/retraining", RESULTS), *verdicts)
    tile = list_tiles(run)[0]
    assert tile.title == "AP50 in grid and ring"
    assert tile.verdict == (verdicts[0] if len({*verdicts}) == 1 else None)
    assert re.search(
        rf"grid [^,]*{'' if tile.verdict else verdicts[0]}, ring [^,]*{'' if tile.verdict else verdicts[1]}$", tile.note
    )


def test_there_is_no_price_where_no_measure_fell_at_home_by_more_than_its_interval() -> None:
    run = judged(Run.load(RUNS / "demo/earlier/float32", RESULTS), HELD)
    assert run.home is not None
    kept = replace(run, home=(replace(run.home[0], difference=Estimate(-0.27, -0.6, 0.06)),))
    answer = tell_answer(kept)
    assert answer is not None
    assert answer.word == "Yes"


def test_numbers_are_means_over_regions_and_trainings_and_megabytes_those_of_the_stage() -> None:
    run = Run.load(RUNS / "demo/earlier/float32", RESULTS)
    answer = tell_answer(run)
    assert answer is not None
    means = {
        stage: np.mean(
            [
                each.estimate.mean
                for each in run.tested
                if (each.arm, each.stage) == ("main", stage) and each.region in ("grid", "ring")
            ]
        )
        for stage in ("pretrain", "edge", "cloud")
    }
    assert [row.estimate.mean for row in list_stage_means(run)] == pytest.approx([*means.values()])
    sent = {
        stage: sum(row.mb for row in run.arms["main"].spent if row.stage == stage and row.link in links)
        for stage, links in (("edge", ("wireless",)), ("cloud", ("wireless", "wireline")))
    }
    assert answer.sentences == (
        f"In two unseen towns: AP50 of objects {means['pretrain']:.3f} → {means['edge']:.3f}, "
        f"for {sent['edge']:.0f} MB of radio.",
        f"One network for all towns, averaged by the cloud for {sent['cloud']:.0f} MB more, has AP50 "
        f"{means['cloud']:.3f}.",
        "At home in suburb, that network loses AP70 0.506 → 0.239.",
    )


def counted(stage: str, region: str, found: float, false: float | None) -> FoundCount:
    return FoundCount("main", stage, region, "objects", "cars", 300, found, false, 3)


def test_counts_take_the_place_of_the_measure_and_are_summed_over_towns() -> None:
    run = Run.load(RUNS / "demo/earlier/float32", RESULTS)
    rows = [(PRETRAIN, 180, 80), (EDGE, 190, 70), (CLOUD, 185, 60)]
    counts = tuple(counted(stage, region, *row) for stage, *row in rows for region in ("grid", "ring"))
    answer = tell_answer(replace(run, counts=counts))
    assert answer is not None
    assert answer.sentences[0] == (
        "In two unseen towns: 360 → 380 of 600 cars found and 160 → 140 false, for 47 MB of radio."
    )
    assert answer.sentences[1].endswith("finds 370, 120 false.")
    partly = tell_answer(replace(run, counts=counts[1:]))
    assert partly is not None
    assert "AP50 of objects" in partly.sentences[0]


def test_tiles_have_the_gain_the_control_the_budget_and_the_cost() -> None:
    tiles = list_tiles(Run.load(RUNS / "demo/earlier/float32", RESULTS))
    assert [tile.title for tile in tiles] == [
        "AP50 in grid and ring", "As many steps without FL", "Radio, all vehicles and stages",
        "AP70 at home, in suburb",
    ]  # fmt: skip
    assert tiles[0].note == "+0.067 (+0.036 to +0.099)"
    assert tiles[1].note == "FL minus it: +0.067 (+0.035 to +0.098)"
    assert tiles[2].value == "78 of 80 MB"
    sent = "27 MB pretraining, 47 MB edge FL of 7 vehicles, 5 MB cloud FL"
    assert tiles[2].note == f"{sent}; wireline: 28 of 40 MB"
    assert tiles[3].value == "0.506 → 0.239"


def test_claims_are_worded_without_the_names_of_arms() -> None:
    run = Run.load(RUNS / "demo/earlier/float32", RESULTS)
    rows = list_claims(run)
    assert [row.verdict for row in rows] == [finding.verdict for finding in run.findings]
    assert (rows[0].claim, rows[1].claim) == (
        "Edge FL beats the pretrained network", "Edge FL beats central training for as many steps",
    )  # fmt: skip
    for row in rows:
        assert row.after - row.before == pytest.approx(row.change.mean, abs=1e-9)
        assert bool(row.needs) == (row.verdict == UNDECIDED)
    assert rows[5].needs == "needs about 8 trainings on 86 scenes"


def test_arms_are_worded_by_what_differs() -> None:
    told = {row.claim for row in list_claims(Run.load(RUNS / "demo/earlier/road", RESULTS))}
    assert "Edge FL beats the pole with the densest traffic" in told
    assert "Edge FL against labels of an ideal road detector, an upper bound" in told


def test_a_run_without_the_claim_has_no_answer() -> None:
    run = Run.load(RUNS / "demo/earlier/float32", RESULTS)
    others = [
        (each, finding)
        for each, finding in zip(run.differences, run.findings, strict=False)
        if each.before_stage != "pretrain"
    ]
    differences, findings = zip(*others, strict=True)
    assert tell_answer(replace(run, differences=differences, findings=findings)) is None


def test_recordings_of_anybody_are_regions_and_no_towns() -> None:
    run = Run.load(RUNS / "demo/earlier/float32", RESULTS)
    regions = {**run.recipe.regions, "ring": run.recipe.regions["ring"].model_copy(update={"data": "drive"})}
    answer = tell_answer(replace(run, recipe=run.recipe.model_copy(update={"regions": regions})))
    assert answer is not None
    assert answer.sentences[0].startswith("In two unseen regions: ")
    assert answer.sentences[1].startswith("One network for all regions, ")
