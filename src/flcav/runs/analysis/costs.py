"""Costs of federated learning: of an arm, and in the towns of pretraining."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flcav.perception.outcomes import (
    Measure,
    Outcomes,
    count_once,
    difference,
    further_measures,
    share_test_scenes,
)
from flcav.perception.tasks import task_named
from flcav.runs.analysis.differences import number_retrainings, test_folder
from flcav.runs.arms import name_repeat
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.run import ArmCost, ArmResult, Run
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.results.tests import HomeCost, Test
from flcav.runs.stages.graph import Graph
from flcav.statistics.estimates import Estimate, average_estimates
from flcav.statistics.seeds import mean_over_seeds
from flcav.storage.records import select


def list_arm_costs(run: Run) -> tuple[ArmCost, ...]:
    """Return a row per arm and task that was tested after federated or centralised training."""
    rows = []
    for name, arm in run.arms.items():
        for task in run.recipe.tasks:
            stages = select(arm.stages, task=task)
            regions = (run.recipe.arms[name].regions if name != MAIN else ()) or run.recipe.with_role("federate")
            tests = select(run.tested, arm=name, stage=stages[-1].stage if stages else "", task=task, region=regions)
            before = select(run.tested, arm=MAIN, stage=PRETRAIN, task=task, region=regions)
            if tests and len(before) == len(tests):
                mean = float(np.mean([test.estimate.mean for test in before]))
                rows.append(_row(name, arm, task, tests, mean))
    return tuple(rows)


def _row(name: str, arm: ArmResult, task: str, tests: Sequence[Test], before: float) -> ArmCost:
    sent = {
        link: sum(row.mb for row in select(arm.spent, task=task, link=link, stage=(EDGE, CLOUD))) for link in arm.links
    }
    rounds = {
        stage: max((result.rounds for result in select(arm.stages, task=task, stage=stage)), default=0)
        for stage in (EDGE, CLOUD)
    }
    after = average_estimates([test.estimate for test in tests])
    gain = after.mean - before
    uplink_mb = sum(sent.values())
    return ArmCost(
        arm=name,
        task=task,
        regions=tuple(test.region for test in tests),
        measure=tests[0].result.measure,
        stage=tests[0].stage,
        wireless_mb=sent["wireless"],
        wireline_mb=sent["wireline"],
        edge_rounds=rounds[EDGE],
        cloud_rounds=rounds[CLOUD],
        epsilon=None if arm.privacy is None else arm.privacy.epsilon,
        before=before,
        after=after,
        gain=gain,
        gain_per_mb=gain / uplink_mb if uplink_mb else None,
    )


def list_edge_points(run: Run) -> dict[tuple[str, str], tuple[float, Estimate]]:
    """Return uplink [MB] and mean measure after edge FL by arm and task, of arms that have a later stage."""
    points = {}
    for cost in list_arm_costs(run):
        tests = select(run.tested, arm=cost.arm, stage=EDGE, task=cost.task, region=cost.regions)
        if cost.stage != EDGE and tests and len(tests) == len(cost.regions):
            mb = sum(row.mb for row in select(run.arms[cost.arm].spent, task=cost.task, stage=EDGE))
            points[cost.arm, cost.task] = (mb, average_estimates([test.estimate for test in tests]))
    return points


def collect_home_costs(graph: Graph, work: Path) -> tuple[HomeCost, ...]:
    """Collect the costs in the towns of pretraining in the tasks' further measures, such as AP70.

    A `Difference` has the main measure.
    """
    return tuple(
        _cost(graph, work, (stage, region, task), name, measure)
        for stage, region, task in graph.tested(graph.settings[MAIN])
        if stage != PRETRAIN and region in graph.recipe.with_role("pretrain")
        for name, measure in further_measures(task_named(task)).items()
    )


def _cost(graph: Graph, work: Path, tested: tuple[str, str, str], name: str, measure: Measure) -> HomeCost:
    stage, region, task = tested
    arms = [name_repeat(MAIN, number) for number in (0, *number_retrainings(graph))]
    pairs = [
        [Outcomes.load(work / test_folder(graph, arm, at, region, task) / OUTCOMES) for at in (PRETRAIN, stage)]
        for arm in arms
    ]
    learned = task_named(task)
    seed = graph.recipe.seed
    values = [[count_once(measure, outcomes) for outcomes in pair] for pair in pairs]
    first, last = pairs[0]
    found = Estimate(*difference(learned, first, last, seed, measure))
    if len(pairs) > 1 and found.low is not None:
        shared = share_test_scenes(learned, pairs, lambda pair: pair[1] - pair[0], seed, measure)
        found = mean_over_seeds([after - before for before, after in values], shared=shared).as_estimate()
    before, after = np.mean(values, axis=0).tolist()
    return HomeCost(region, task, name, before, after, found, len(pairs))


def list_home_costs(run: Run) -> list[HomeCost]:
    """Return the costs of federated learning in the towns of pretraining, in the tasks' main and further measures.

    In results of earlier versions, further measures are those of the first training and have no interval.
    """
    tests = {test.key: test for test in run.tested}
    costs = []
    towns = run.recipe.with_role("pretrain")
    for at_home in select(run.differences, arm=MAIN, before_arm=MAIN, before_stage=PRETRAIN, region=towns):
        pair = [tests[MAIN, stage, at_home.region, at_home.task] for stage in (PRETRAIN, at_home.stage)]
        before, after = (test.estimate.mean for test in pair)
        trainings = len(at_home.trainings)
        costs.append(
            HomeCost(at_home.region, at_home.task, pair[0].result.measure, before, after, at_home.estimate, trainings)
        )
        kept = select(run.home or (), region=at_home.region, task=at_home.task)
        for name in () if kept else further_measures(task_named(at_home.task)):
            before, after = (test.result.numbers.get(name) for test in pair)
            if before is not None and after is not None:
                change = Estimate(after - before, None, None)
                kept.append(HomeCost(at_home.region, at_home.task, name, before, after, change, 1))
        costs += kept
    return costs
