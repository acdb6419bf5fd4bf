"""Tests of a run's networks, collected from their steps: intervals over scenes and over retrainings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flcav.perception.outcomes import Outcomes, Values, share_test_scenes
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import Setting, name_repeat
from flcav.pipeline.graph.graph import Graph
from flcav.pipeline.results.saved import OUTCOMES
from flcav.pipeline.results.tests import RegionalTest, Test, Tested
from flcav.pipeline.spread import test_key
from flcav.statistics.estimates import Estimate, measure_spread, widen_share
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds


def collect_test(graph: Graph, work: Path, arm: str, stage: str, region: str, task: str) -> Test:
    """Return the test of an arm's network after a stage, with the spread over retrainings where it is known."""
    step = test_folder(graph, arm, stage, region, task)
    result = Tested.load(work / step)
    again = [test_folder(graph, name_repeat(arm, n), stage, region, task) for n in number_retrainings(graph)]
    retrained = tuple(Tested.load(work / each).estimate.mean for each in again)
    values = (result.estimate.mean, *retrained)
    spread = measure_spread(values) or graph.spreads.get(test_key(task, region, arm, stage))
    folders = [(work / each,) for each in (step, *again)]
    mean = mean_over_trainings(task, result.estimate, values, folders, graph.recipe.seed, share=True)
    estimate = result.estimate
    if mean is not None:
        estimate = mean.as_estimate()
    elif spread is not None:
        estimate = widen_share(estimate, spread)
    return Test(arm, stage, region, task, step, result, estimate, spread, retrained, mean, tuple(again) or None)


def mean_over_trainings(
    task: str, first: Estimate, values: Sequence[float], tests: Sequence[Sequence[Path]], seed: int, *, share: bool
) -> MeanOverSeeds | None:
    """Return `mean_of_tests` of a run's own trainings, which share all test scenes.

    `first`: that of the first training over its scenes. None for one training, and where scenes give no interval.
    """
    if len(values) < 2 or first.low is None:
        return None
    return mean_of_tests(task, values, tests, seed, share=share)


def mean_of_tests(
    task: str, values: Sequence[float], tests: Sequence[Sequence[Path]], seed: int = 0, *, share: bool = False
) -> MeanOverSeeds:
    """Return the mean over trainings of a measure, or of the difference of two: over seeds, or of one run.

    `tests`: for each training the folder of the test, or of the later and the earlier one. `seed`: of the draws of
    scenes. `share`: a number in [0, 1].
    """
    outcomes = [[Outcomes.load(folder / OUTCOMES) for folder in own] for own in tests]
    shared = share_test_scenes(task_named(task), outcomes, _subtract, seed)
    return mean_over_seeds(values, shared=shared, share=share)


def _subtract(measures: Sequence[Values]) -> Values:
    return np.subtract(*measures) if len(measures) > 1 else measures[0]


def number_retrainings(graph: Graph) -> range:
    """Return the numbers of the retrainings of every arm, from 1."""
    return range(1, 1 + graph.recipe.retrainings)


def test_folder(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the name of the step, and of its folder, that tested an arm's network after a stage."""
    return graph.names.test(graph.names.stage(arm, stage, region, task), region)


def collect_regional_tests(graph: Graph, work: Path, arm: Setting) -> tuple[RegionalTest, ...]:
    """Return the tests of the models that an arm's regions keep for themselves."""
    found = []
    for stage, region, task in graph.tested(arm):
        trained = graph.names.stage(arm.name, stage, region, task)
        for model in graph.models(arm, stage):
            if model is not None:
                tested = Tested.load(work / graph.names.test(trained, region, model))
                found.append(RegionalTest(model, region, task, tested.measure, tested.estimate))
    return tuple(found)
