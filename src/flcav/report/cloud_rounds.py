"""Cloud rounds over retrainings: weight divergence of the regions, and gains of cloud FL over edge FL."""

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
    """Return Markdown tables by name: divergence and gain of each training, and scores by normalisation statistics.

    They are of the main arm. A table is missing where stage III did not measure its values, as in older results;
    divergence also needs retrainings.
    """
    tables: dict[str, str] = {}
    trained = {task: stages for task in run.recipe.tasks if (stages := _trainings(run, task))}
    if trained and run.recipe.retrainings and all(_span(stage) for stages in trained.values() for stage in stages):
        tables["divergence"] = "\n\n".join(_divergence(run, task, stages) for task, stages in trained.items())
    if trained and all(stage.statistics for stages in trained.values() for stage in stages):
        tables["statistics"] = "\n\n".join(_statistics(task, stages) for task, stages in trained.items())
    return tables


def _trainings(run: Run, task: str) -> list[StageResult]:
    """Return stage III of a task in the main run, followed by its retrainings."""
    main = run.arms[MAIN]
    return select((*main.stages, *(main.retrained or ())), stage=CLOUD, task=task)


def _span(stage: StageResult) -> RoundDivergence | None:
    return span_divergence(stage.records or ())


def _divergence(run: Run, task: str, trainings: Sequence[StageResult]) -> str:
    measured = [span for stage in trainings if (span := _span(stage)) is not None]
    gains = {f"{region}: cloud - edge FL": values for region, values in _gains(run, task).items()}
    return format_divergence([f"{task}, training {i + 1}" for i in range(len(trainings))], measured, gains)


def span_divergence(records: Iterable[FederatedRound]) -> RoundDivergence | None:
    """Return the divergence at the start of the first cloud round and that before averaging in the last one.

    None where `records` have no cloud round of several regions.
    """
    rounds = [record.divergence for record in records if record.divergence is not None]
    return RoundDivergence(rounds[0].begun, rounds[-1].trained) if rounds else None


def _gains(run: Run, task: str) -> Mapping[str, Sequence[float]]:
    """Return edge + cloud FL minus edge FL in each federating region, in each training."""
    compared = select(run.differences, arm=MAIN, stage=CLOUD, before_arm=MAIN, before_stage=EDGE, task=task)
    return {difference.region: (difference.over_scenes.mean, *difference.retrained) for difference in compared}


def format_divergence(
    names: Sequence[str], measured: Sequence[RoundDivergence], gains: Mapping[str, Sequence[float]]
) -> str:
    """Return a table with a row per training, the means, and Spearman's rank correlations with the mean gain.

    `names` are those of the trainings; `gains` has one value per training, by the name of the comparison.
    """
    columns: dict[str, list[float]] = {}
    for when, moment in (("after edge FL", "begun"), ("before averaging", "trained")):
        for part in PARTS:
            values = [getattr(getattr(divergence, moment), part) for divergence in measured]
            if None not in values:
                columns[f"{part}, {when}"] = values
    gain = np.mean([*gains.values()], axis=0)
    shown = {**gains, "mean gain": gain} if len(gains) > 1 else gains
    rows = [
        [
            name,
            *(f"{column[number]:.4f}" for column in columns.values()),
            *(f"{column[number]:+.3f}" for column in shown.values()),
        ]
        for number, name in enumerate(names)
    ]
    means = [f"{np.mean(column):.4f}" for column in columns.values()]
    rows.append(["mean", *means, *(f"{np.mean(column):+.3f}" for column in shown.values())])
    correlations = (describe_correlation(column, gain) for column in columns.values())
    rows.append([CORRELATION, *correlations, *("" for _ in shown)])
    return format_table(("", *columns, *shown), rows)


def describe_correlation(values: Sequence[float], gain: Sequence[float]) -> str:
    """Return Spearman's rho with its p-value by a permutation test, which is exact up to 8 trainings.

    The text is empty where one side is constant, and for fewer than 3 trainings.
    """
    if len(values) < 3 or len({*values}) == 1 or len({*gain}) == 1:
        return ""
    ranks, of_gain = rankdata(values), rankdata(gain)
    # Under permutation, rho is a monotone function of this inner product of ranks.
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
    """Return a row per region: scores with averaged and with local statistics, and the mean paired difference."""
    rows = []
    regions = [scores.region for scores in trainings[0].statistics or ()]
    for place, region in enumerate(regions):
        scores = [stage.statistics[place] for stage in trainings if stage.statistics]
        averaged = np.array([score.averaged for score in scores])
        local = np.array([score.own for score in scores])
        gained = local - averaged
        spread = f", sd {np.std(gained, ddof=1):.3f}" if len(gained) > 1 else ""
        means = (f"{averaged.mean():.3f}", f"{local.mean():.3f}", f"{gained.mean():+.3f}{spread}")
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
