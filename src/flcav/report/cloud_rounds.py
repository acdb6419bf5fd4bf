"""Cloud rounds over retrainings: weight divergence of the regions, and what their mean gains over stage II."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import permutation_test, rankdata

from flcav.federation.state import RoundDivergence
from flcav.runs.recipe import CLOUD, EDGE, MAIN
from flcav.runs.results.run import Run
from flcav.runs.results.training import FederatedRound, StageResult
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import select

PARTS = ("whole", "learned", "statistics")  # of `Divergence`
CORRELATION = "rank correlation with the mean gain"
PERMUTATIONS = 50_000  # more than those of 8 trainings


def cloud_tables(run: Run) -> dict[str, str]:
    """Return Markdown by name: divergence and gain of each training of the run itself, and scores by statistics.

    Only what the run's stage III measured: older results have neither, and divergence needs retrainings.
    """
    found: dict[str, str] = {}
    kept = {task: own for task in run.recipe.tasks if (own := _trainings(run, task))}
    if kept and run.recipe.retrainings and all(_span(stage) for own in kept.values() for stage in own):
        found["divergence"] = "\n\n".join(_divergence(run, task, own) for task, own in kept.items())
    if kept and all(stage.statistics for own in kept.values() for stage in own):
        found["statistics"] = "\n\n".join(_statistics(task, own) for task, own in kept.items())
    return found


def _trainings(run: Run, task: str) -> list[StageResult]:
    """Return stage III of a task, of the run and of its retrainings; the run's first."""
    main = run.arms[MAIN]
    return select((*main.stages, *(main.retrained or ())), stage=CLOUD, task=task)


def _span(stage: StageResult) -> RoundDivergence | None:
    return span_divergence(stage.records or ())


def _divergence(run: Run, task: str, trainings: Sequence[StageResult]) -> str:
    measured = [found for stage in trainings if (found := _span(stage)) is not None]
    gains = {f"{region}: cloud - edge FL": own for region, own in _gains(run, task).items()}
    return format_divergence([f"{task}, training {i + 1}" for i in range(len(trainings))], measured, gains)


def span_divergence(records: Iterable[FederatedRound]) -> RoundDivergence | None:
    """Return the divergence that the first cloud round begins with, and that of what the last one averages.

    None where there was no cloud round of several regions among `records`.
    """
    rounds = [each.divergence for each in records if each.divergence is not None]
    return RoundDivergence(rounds[0].begun, rounds[-1].trained) if rounds else None


def _gains(run: Run, task: str) -> Mapping[str, Sequence[float]]:
    """Return edge + cloud FL minus edge FL in each federating region, in each training."""
    compared = select(run.differences, arm=MAIN, stage=CLOUD, before_arm=MAIN, before_stage=EDGE, task=task)
    return {each.region: (each.over_scenes.mean, *each.retrained) for each in compared}


def format_divergence(
    names: Sequence[str], measured: Sequence[RoundDivergence], gains: Mapping[str, Sequence[float]]
) -> str:
    """Return a row per training, the means, and each column's rank correlation (Spearman's rho) with the mean gain.

    names: of the trainings. gains: of each training, by the name of the comparison.
    """
    columns: dict[str, list[float]] = {}
    for when, own in (("after edge FL", "begun"), ("before averaging", "trained")):
        for part in PARTS:
            values = [getattr(getattr(each, own), part) for each in measured]
            if None not in values:
                columns[f"{part}, {when}"] = values
    gain = np.mean([*gains.values()], axis=0)
    shown = {**gains, "mean gain": gain} if len(gains) > 1 else gains
    rows = [
        [name, *(f"{own[number]:.4f}" for own in columns.values()), *(f"{own[number]:+.3f}" for own in shown.values())]
        for number, name in enumerate(names)
    ]
    means = [f"{np.mean(own):.4f}" for own in columns.values()]
    rows.append(["mean", *means, *(f"{np.mean(own):+.3f}" for own in shown.values())])
    rows.append([CORRELATION, *(describe_correlation(own, gain) for own in columns.values()), *("" for _ in shown)])
    return format_table(("", *columns, *shown), rows)


def describe_correlation(values: Sequence[float], gain: Sequence[float]) -> str:
    """Return Spearman's rho with its p-value by a permutation test, which is exact up to 8 trainings.

    The text is empty where one side is constant, and for fewer than 3 trainings.
    """
    if len(values) < 3 or len({*values}) == 1 or len({*gain}) == 1:
        return ""
    ranks, of_gain = rankdata(values), rankdata(gain)
    centred = of_gain - of_gain.mean()
    drawn = permutation_test(
        (ranks,),
        lambda order, axis: np.tensordot(order, centred, (axis, 0)),
        permutation_type="pairings",
        n_resamples=PERMUTATIONS,
        rng=stream(0, "permutations"),
    )
    return f"{np.corrcoef(ranks, of_gain)[0, 1]:+.2f} (p {drawn.pvalue:.2f})"


def _statistics(task: str, trainings: Sequence[StageResult]) -> str:
    """Return a row per region: scores with averaged and with own statistics, and the mean of the paired differences."""
    rows, regions = [], [each.region for each in trainings[0].statistics or ()]
    for place, region in enumerate(regions):
        scores = [stage.statistics[place] for stage in trainings if stage.statistics]
        averaged, own = (np.array([getattr(each, kind) for each in scores]) for kind in ("averaged", "own"))
        gained = own - averaged
        spread = f", sd {np.std(gained, ddof=1):.3f}" if len(gained) > 1 else ""
        means = (f"{averaged.mean():.3f}", f"{own.mean():.3f}", f"{gained.mean():+.3f}{spread}")
        rows.append([f"{region}, {task}", len(scores), scores[0].frames, *means])
    header = (
        "region, task",
        "trainings",
        "validation frames",
        "averaged statistics",
        "own statistics",
        "own - averaged",
    )
    return format_table(header, rows)
