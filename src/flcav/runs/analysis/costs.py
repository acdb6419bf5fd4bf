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
    """Return a row for each arm and task that was tested after federating, or after training centrally."""
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
        stage: max((each.rounds for each in select(arm.stages, task=task, stage=stage)), default=0)
        for stage in (EDGE, CLOUD)
    }
    after = average_estimates([test.estimate for test in tests])
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


def tell_gain(run: Run) -> tuple[str, ...]:
    """Return sentences for each task: what the run gained, for how many megabytes, and at what cost at home."""
    told, home, arm = [], list_home_costs(run), run.arms[MAIN]
    for cost in select(list_arm_costs(run), arm=MAIN):
        links = [f"{arm.sent_mb(cost.task, link):.1f} MB of {link} uplink" for link in arm.links]
        told.append(
            f"Federated learning took {cost.measure} of {cost.task} from {cost.before:.3f} to {cost.after.mean:.3f} on "
            f"{' and '.join(cost.regions)}, for {' and '.join(links)}, pretraining included."
        )
        for region in dict.fromkeys(each.region for each in select(home, task=cost.task)):
            changes = [
                f"{each.measure} from {each.before:.3f} to {each.after:.3f}"
                for each in select(home, region=region, task=cost.task)
            ]
            told.append(f"On {region}, where it was pretrained, it took {' and '.join(changes)}.")
    return tuple(told)


def collect_home_costs(graph: Graph, work: Path) -> tuple[HomeCost, ...]:
    """Return the costs at home by the tasks' further measures, such as AP70; `Difference` has the main measure."""
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
        [Outcomes.load(work / test_folder(graph, arm, each, region, task) / OUTCOMES) for each in (PRETRAIN, stage)]
        for arm in arms
    ]
    own, seed = task_named(task), graph.recipe.seed
    values = [[count_once(measure, outcomes) for outcomes in pair] for pair in pairs]
    first, last = pairs[0]
    found = Estimate(*difference(own, first, last, seed, measure))
    if len(pairs) > 1 and found.low is not None:
        shared = share_test_scenes(own, pairs, lambda pair: pair[1] - pair[0], seed, measure)
        found = mean_over_seeds([after - before for before, after in values], shared=shared).as_estimate()
    before, after = np.mean(values, axis=0).tolist()
    return HomeCost(region, task, name, before, after, found, len(pairs))


def list_home_costs(run: Run) -> list[HomeCost]:
    """Return the cost of federated learning in the towns of pretraining, by each task's main and further measures.

    Results that were collected before further measures had intervals give those of the first training without one.
    """
    tests = {test.key: test for test in run.tested}
    costs = []
    towns = run.recipe.with_role("pretrain")
    for each in select(run.differences, arm=MAIN, before_arm=MAIN, before_stage=PRETRAIN, region=towns):
        pair = [tests[MAIN, stage, each.region, each.task] for stage in (PRETRAIN, each.stage)]
        before, after = (test.estimate.mean for test in pair)
        trainings = len(each.trainings)
        costs.append(HomeCost(each.region, each.task, pair[0].result.measure, before, after, each.estimate, trainings))
        kept = select(run.home or (), region=each.region, task=each.task)
        for name in () if kept else further_measures(task_named(each.task)):
            before, after = (test.result.numbers.get(name) for test in pair)
            if before is not None and after is not None:
                change = Estimate(after - before, None, None)
                kept.append(HomeCost(each.region, each.task, name, before, after, change, 1))
        costs += kept
    return costs
