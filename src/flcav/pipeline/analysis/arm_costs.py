"""Megabytes, rounds, epsilon and accuracy of each arm of a run: what an arm costs, and what it gains for that."""

from collections.abc import Sequence

import numpy as np

from flcav.pipeline.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.pipeline.results.run import ArmCost, ArmResult, Run
from flcav.pipeline.results.tests import Test
from flcav.statistics.estimates import Estimate


def list_arm_costs(run: Run) -> tuple[ArmCost, ...]:
    """Return a row for each arm and task that was tested after federating, or after training centrally."""
    rows = []
    for name, arm in run.arms.items():
        for task in run.recipe.tasks:
            stages = [each for each in arm.stages if each.task == task]
            regions = {each.region for each in stages if each.region}
            tests = _find_tests(run, name, task, stages[-1].stage if stages else "", regions)
            before = _find_tests(run, MAIN, task, PRETRAIN, regions)
            if tests and len(before) == len(tests):
                mean = float(np.mean([test.estimate.mean for test in before]))
                rows.append(_row(name, arm, task, tests, mean))
    return tuple(rows)


def _find_tests(run: Run, arm: str, task: str, stage: str, regions: set[str]) -> list[Test]:
    asked = (arm, stage, task)
    return [test for test in run.tested if (test.arm, test.stage, test.task) == asked and test.region in regions]


def _row(name: str, arm: ArmResult, task: str, tests: Sequence[Test], before: float) -> ArmCost:
    sent = {
        link: sum(row.mb for row in arm.spent if (row.task, row.link) == (task, link) and row.stage != PRETRAIN)
        for link in arm.links
    }
    rounds = {
        stage: max((each.rounds for each in arm.stages if (each.task, each.stage) == (task, stage)), default=0)
        for stage in (EDGE, CLOUD)
    }
    after = _mean_of([test.estimate for test in tests])
    gain, uplink_mb = after.mean - before, sum(sent.values())
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


def _mean_of(regions: Sequence[Estimate]) -> Estimate:
    """Return the mean over regions, whose test scenes are independent; its interval by their half widths."""
    mean = float(np.mean([each.mean for each in regions]))
    ends = [
        (each.mean - each.low, each.high - each.mean)
        for each in regions
        if each.low is not None and each.high is not None
    ]
    if len(ends) < len(regions):
        return Estimate(mean, None, None)
    below, above = np.sqrt(np.square(ends).sum(axis=0)) / len(regions)
    return Estimate(mean, mean - float(below), mean + float(above))
