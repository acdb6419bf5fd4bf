"""Learning history of a finished run, and the gap to centralised training that it closed."""

from collections.abc import Sequence

from flcav.pipeline.analysis.findings import name_stage
from flcav.pipeline.planning.histories import HistoryPoint
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.pipeline.results.run import Run
from flcav.pipeline.results.tests import Test
from flcav.pipeline.results.training import average_regions


def gap_closed(start: float, reached: float, end: float) -> float:
    """Return the fraction (reached - start) / (end - start) of a gap that was closed; 0 where there is no gap."""
    return (reached - start) / (end - start) if end != start else 0.0


def gaps_closed(tests: Sequence[Test], recipe: RunRecipe) -> dict[str, float]:
    """Return the fraction of the gap from pretraining to centralised training that each stage closes, by its name.

    The reference trains on the region's own ground truth; regions without such an arm are left out.
    """
    values = {(test.arm, test.stage, test.region, test.task): test.estimate.mean for test in tests}
    oracle = next((name for name, arm in recipe.arms.items() if arm.central == "federate"), None)
    closed = {}
    for (arm, stage, region, task), reached in values.items():
        end = values.get((oracle or "", CENTRAL, region, task))
        if end is not None and stage != PRETRAIN and arm != oracle:
            start = values.get((arm, PRETRAIN, region, task), values[MAIN, PRETRAIN, region, task])
            closed[f"{region}, {task}: {name_stage(arm, stage)}"] = gap_closed(start, reached, end)
    return closed


def make_history_points(result: Run, run: str) -> list[HistoryPoint]:
    """Return a run's points of the learning history: samples, rounds, and the score they reached.

    The score is the mean over regions on validation frames, weighted by frames.
    """
    points: list[HistoryPoint] = []
    for task, own in result.arms[MAIN].plan.tasks.items():
        for stage in (PRETRAIN, EDGE, CLOUD):
            each = [watched for watched in result.watched if (watched.task, watched.stage) == (task, stage)]
            frames = sum(watched.frames for watched in each)
            for at in average_regions(each):
                counts = (own.edge_rounds, at.round) if stage == CLOUD else (at.round, 0)
                points.append(HistoryPoint(task, own.samples, *counts, at.score, frames, run, result.recipe.seed))
    return points
