"""The answer to the title of a run's report follows from its verdicts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.report.pages.html import render
from flcav.report.pages.run_page import page
from flcav.runs.analysis.answer import list_stage_means, tell_answer
from flcav.runs.results.run import Run
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
    run = judged(Run.load(RUNS / "demo", RESULTS), *verdicts)
    answer = tell_answer(run)
    assert answer is not None
    assert answer.word == word
    assert f"({verdicts[0]}: " in answer.sentences[0]
    assert f"<b>{word}.</b> In grid and ring, edge FL took AP50" in render(page(run), {})


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
    answer = tell_answer(judged(Run.load(RUNS / "retraining", RESULTS), *verdicts))
    assert answer is not None
    assert answer.word == word
    for region, verdict, sentence in zip(("grid", "ring"), verdicts, answer.sentences, strict=False):
        assert sentence.startswith(f"In {region}, edge FL took AP50 of objects from ")
        assert f"({verdict}: " in sentence


def test_there_is_no_price_where_no_measure_fell_at_home_by_more_than_its_interval() -> None:
    run = judged(Run.load(RUNS / "demo", RESULTS), HELD)
    assert run.home is not None
    kept = replace(run, home=(replace(run.home[0], difference=Estimate(-0.27, -0.6, 0.06)),))
    answer = tell_answer(kept)
    assert answer is not None
    assert answer.word == "Yes"


def test_numbers_are_means_over_regions_and_trainings_and_megabytes_those_of_the_stage() -> None:
    run = Run.load(RUNS / "demo", RESULTS)
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
    assert f"from {means['pretrain']:.3f} to {means['edge']:.3f}" in answer.sentences[0]
    sent = {
        stage: sum(row.mb for row in run.arms["main"].spent if row.stage == stage and row.link != "sidelink")
        for stage in ("edge", "cloud")
    }
    assert answer.sentences[1] == f"This took {sent['edge']:.1f} MB of uplink."
    assert answer.sentences[2].startswith(f"Cloud FL took it to {means['cloud']:.3f} (")
    assert answer.sentences[2].endswith(f"for {sent['cloud']:.1f} MB more.")
    assert "AP50 of objects from 0.820 to 0.804 and AP70 of objects from 0.506 to 0.239" in answer.sentences[3]


def test_a_run_without_the_claim_has_no_answer() -> None:
    run = Run.load(RUNS / "demo", RESULTS)
    others = [
        (each, finding)
        for each, finding in zip(run.differences, run.findings, strict=False)
        if each.before_stage != "pretrain"
    ]
    differences, findings = zip(*others, strict=True)
    assert tell_answer(replace(run, differences=differences, findings=findings)) is None
