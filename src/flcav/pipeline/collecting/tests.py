"""Tests of a run's networks, collected from their steps: intervals over scenes and over retrainings."""

from pathlib import Path

from flcav.intervals import measure_spread, widen_share
from flcav.pipeline.arms import Setting, name_repeat
from flcav.pipeline.graph.graph import Graph
from flcav.pipeline.results.tests import RegionalTest, Test, Tested
from flcav.pipeline.seeds.spread import test_key


def collect_test(graph: Graph, work: Path, arm: str, stage: str, region: str, task: str) -> Test:
    """Return the test of an arm's network after a stage, with the spread over retrainings where it is known."""
    step = test_folder(graph, arm, stage, region, task)
    result = Tested.load(work / step)
    again = [test_folder(graph, name_repeat(arm, n), stage, region, task) for n in number_retrainings(graph)]
    retrained = tuple(Tested.load(work / each).estimate.mean for each in again)
    spread = measure_spread((result.estimate.mean, *retrained)) or graph.spreads.get(test_key(task, region, arm, stage))
    estimate = result.estimate if spread is None else widen_share(result.estimate, spread)
    return Test(arm, stage, region, task, step, result, estimate, spread, retrained)


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
