"""Means over the seeds of a run: measures, differences and closed gaps, with intervals over seeds and scenes."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flcav.runs.analysis.differences import mean_of_tests
from flcav.runs.analysis.findings import ask_all, judge_asked
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import MAIN
from flcav.runs.results.run import ClaimCount, Mean, Run, Summary
from flcav.runs.results.tests import Difference, Test
from flcav.statistics.seeds import MeanOverSeeds, average_shared, mean_over_seeds
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED

VERDICTS = (HELD, NOT_HELD, UNDECIDED)  # of a claim


def summarise(runs: Sequence[Run], works: Sequence[Path]) -> Summary:
    """Return means over the seeds of a recipe; `works`: folders of the runs' steps, with the outcomes of their tests.

    A seed's number is the mean over its trainings. The claims that the run itself is better are judged as in its
    findings. Simulated towns have different traffic for every seed. Where seeds are tested on the same recorded scenes,
    the intervals include the variation of these scenes; those of closed gaps do not.
    """
    tests = [{test.key: test for test in run.tested} for run in runs]
    measures = [
        Mean(first.name, _mean_measure([by_key[key] for by_key in tests], works)) for key, first in tests[0].items()
    ]
    differences = [
        Mean(rows[0].name, _mean_difference(rows, tests, works))
        for rows in zip(*(run.differences for run in runs), strict=True)
    ]
    recipe = runs[0].recipe
    settings = resolve_settings(recipe)
    numbers = [number for number, each in enumerate(runs[0].differences) if each.arm == MAIN]
    questions = ask_all([runs[0].differences[number] for number in numbers], recipe, settings)
    judged = judge_asked(questions, [differences[number].estimate for number in numbers])
    for number, about, one in zip(numbers, questions, judged, strict=True):
        differences[number] = replace(differences[number], judged=one, kind=about.named)
    closed = [Mean(name, mean_over_seeds([run.gap_closed[name] for run in runs])) for name in runs[0].gap_closed]
    return Summary(
        tuple(run.recipe.seed for run in runs),
        tuple(measures),
        tuple(differences),
        tuple(closed),
        count_claims(runs),
    )


def count_claims(runs: Sequence[Run]) -> tuple[ClaimCount, ...]:
    """Count the verdicts on every claim over runs that ask the same questions."""
    claims = []
    for one, *others in zip(*(run.findings for run in runs), strict=True):
        ways = Counter(finding.verdict for finding in (one, *others))
        if one.verdict in VERDICTS:
            claims.append(ClaimCount(one.question, one.place, one.kind, *(ways[way] for way in VERDICTS)))
    return tuple(claims)


def _mean_measure(tests: Sequence[Test], works: Sequence[Path]) -> MeanOverSeeds:
    folders = [[work / test.step] for test, work in zip(tests, works, strict=True)]
    return mean_of_tests(tests[0].task, [test.estimate.mean for test in tests], folders, share=True)


def _mean_difference(
    rows: Sequence[Difference], tests: Sequence[dict[tuple[str, str, str, str], Test]], works: Sequence[Path]
) -> MeanOverSeeds:
    one = rows[0]
    values = [row.estimate.mean for row in rows]
    parts = []
    pair = ((one.arm, one.stage), (one.before_arm, one.before_stage))
    for region in one.places:
        folders = []
        for by_key, work in zip(tests, works, strict=True):
            tested = [by_key.get((*at, region, one.task)) or by_key[MAIN, at[1], region, one.task] for at in pair]
            folders.append([work / test.step for test in tested])
        parts.append(mean_of_tests(one.task, values, folders).shared)
    return mean_over_seeds(values, shared=average_shared(parts))
