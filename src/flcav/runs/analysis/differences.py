"""Tests of a run's networks and their paired differences, with intervals over scenes and retrainings."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.perception.outcomes import Counts, Outcomes, Values, difference, share_test_scenes
from flcav.perception.tasks import task_named
from flcav.runs.analysis.findings import is_joint, pair_of
from flcav.runs.arms import Setting, name_repeat
from flcav.runs.recipe import ALL, CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.results.tests import Difference, FoundCount, RegionalTest, Test, Tested, name_stage
from flcav.runs.spread import figure_key, test_key
from flcav.runs.stages.graph import Graph
from flcav.statistics.estimates import Estimate, Spread, average_estimates, measure_spread, widen, widen_share
from flcav.statistics.seeds import MeanOverSeeds, average_shared, mean_over_seeds


def collect_test(graph: Graph, work: Path, arm: str, stage: str, region: str, task: str) -> Test:
    """Return the test of an arm's network after a stage, with the spread over retrainings where it is known."""
    step = test_folder(graph, arm, stage, region, task)
    result = Tested.load(work / step)
    again = [test_folder(graph, name_repeat(arm, n), stage, region, task) for n in number_retrainings(graph)]
    again = [name for name in again if name != step]  # drops those that share this network
    repeated = [Tested.load(work / name) for name in again]
    retrained = tuple(tested.estimate.mean for tested in repeated)
    values = (result.estimate.mean, *retrained)
    spread = measure_spread(values) or graph.spreads.get(test_key(task, region, arm, stage))
    folders = [(work / name,) for name in (step, *again)]
    mean = mean_over_trainings(task, result.estimate, values, folders, graph.recipe.seed, share=True)
    estimate = result.estimate
    if mean is not None:
        estimate = mean.as_estimate()
    elif spread is not None:
        estimate = widen_share(estimate, spread)
    numbers = _average_numbers([result, *repeated]) if repeated else None
    trained = {"retrained": retrained, "over_trainings": mean, "retrained_steps": tuple(again) or None}
    return Test(arm, stage, region, task, step, result, estimate, spread, **trained, averaged=numbers)


def _average_numbers(tests: Sequence[Tested]) -> dict[str, float | None]:
    """Return the means over trainings of the further numbers of a test; None for one that a training lacks."""
    by_name = {name: [test.numbers.get(name) for test in tests] for name in tests[0].numbers}
    known = {name: [value for value in values if value is not None] for name, values in by_name.items()}
    return {name: float(np.mean(values)) if len(values) == len(tests) else None for name, values in known.items()}


def count_found(work: Path, test: Test) -> FoundCount | None:
    """Return what the networks of a test found, as means over its trainings; None for a task that does not count."""
    task = task_named(test.task)
    if not isinstance(task, Counts):
        return None
    counted = [task.count(Outcomes.load(work / step / OUTCOMES)) for step in test.steps]
    false = [each.false for each in counted if each.false is not None]
    return FoundCount(
        *(test.arm, test.stage, test.region, test.task, counted[0].noun, counted[0].targets),
        found=float(np.mean([each.found for each in counted])),
        false=float(np.mean(false)) if false else None,
        trainings=len(counted),
    )


def mean_over_trainings(
    task: str, first: Estimate, values: Sequence[float], tests: Sequence[Sequence[Path]], seed: int, *, share: bool
) -> MeanOverSeeds | None:
    """Return `mean_of_tests` of the trainings of one run, which share all test scenes.

    `first`: estimate of the first training over its scenes. None for one training, and where scenes give no interval.
    """
    if len(values) < 2 or first.low is None:
        return None
    return mean_of_tests(task, values, tests, seed, share=share)


def mean_of_tests(
    task: str, values: Sequence[float], tests: Sequence[Sequence[Path]], seed: int = 0, *, share: bool = False
) -> MeanOverSeeds:
    """Return the mean over trainings, of one run or of several seeds, of a measure or of the difference of two.

    `values`: the number by training. `tests`: by training the folder of the test, or of the later and the earlier one.
    `seed`: of the bootstrap over scenes. `share`: whether the number is a share in [0, 1], whose interval is on the
    scale of log-odds.
    """
    outcomes = [[Outcomes.load(folder / OUTCOMES) for folder in folders] for folders in tests]
    shared = share_test_scenes(task_named(task), outcomes, _subtract, seed)
    return mean_over_seeds(values, shared=shared, share=share)


def _subtract(measures: Sequence[Values]) -> Values:
    return np.subtract(*measures) if len(measures) > 1 else measures[0]


def number_retrainings(graph: Graph) -> range:
    """Return the numbers of the retrainings of every arm, from 1."""
    return range(1, 1 + graph.recipe.retrainings)


def test_folder(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the name of the step, and so of the folder, that tested an arm's network after a stage."""
    return graph.names.test(graph.names.stage(arm, stage, region, task), region)


def collect_regional_tests(graph: Graph, work: Path, arm: Setting) -> tuple[RegionalTest, ...]:
    """Collect the tests of the personalised models of an arm's regions."""
    found = []
    for stage, region, task in graph.tested(arm):
        trained = graph.names.stage(arm.name, stage, region, task)
        for model in graph.models(arm, stage):
            if model is not None:
                tested = Tested.load(work / graph.names.test(trained, region, model))
                found.append(RegionalTest(model, region, task, tested.measure, tested.estimate))
    return tuple(found)


def list_differences(graph: Graph, work: Path) -> list[Difference]:
    """List the differences of the stages to the ones before, and of the run itself to its arms at the same stage.

    The differences of primary claims come first, as means over regions.
    """
    main = graph.settings[MAIN]
    pairs: list[tuple[tuple[str, str], tuple[str, str], str, str]] = []
    for arm in graph.settings.values():
        for stage, region, task in () if arm.repeat else graph.tested(arm):
            if stage != PRETRAIN:
                earlier = EDGE if stage in (CLOUD, MORE_EDGE) and region in arm.regions else PRETRAIN
                pairs.append(((arm.name, stage), (arm.name, earlier), region, task))
            if arm.name != MAIN and (region in main.regions or stage != EDGE):
                # Central training takes as many steps as stage II; on all regions it corresponds to cloud FL, which
                # further edge rounds replace.
                matching = CLOUD if arm.central == ALL else {CENTRAL: EDGE, MORE_EDGE: CLOUD}.get(stage, stage)
                pairs.append(((MAIN, matching), (arm.name, stage), region, task))
    found: dict[tuple[str, str], Difference] = {}
    for after, before, region, task in pairs:
        steps = test_folder(graph, *after, region, task), test_folder(graph, *before, region, task)
        if steps[0] != steps[1] and steps not in found:
            found[steps] = _difference(graph, work, after, before, region, task)
    return [*_join_regions(graph, found.values()), *found.values()]


def _join_regions(graph: Graph, differences: Iterable[Difference]) -> Iterator[Difference]:
    """Yield the means over regions of the differences of the recipe's primary claims."""
    groups: dict[tuple[str, ...], list[Difference]] = {}
    for regional in differences:
        if is_joint(regional, graph.recipe, graph.settings):
            groups.setdefault(pair_of(regional), []).append(regional)
    for group in groups.values():
        yield _join(graph, group)


def _join(graph: Graph, group: Sequence[Difference]) -> Difference:
    """Return the mean over regions of a difference; regions have independent test scenes."""
    first = group[0]
    regions = tuple(regional.region for regional in group)
    place = " and ".join(regions)
    over_scenes = average_estimates([regional.over_scenes for regional in group])
    values = np.mean([regional.trainings for regional in group], axis=0).tolist()
    joint = replace(
        first,
        name=first.name.replace(first.region, place, 1),
        region=place,
        estimate=over_scenes,
        over_scenes=over_scenes,
        spread=measure_spread(values),
        retrained=tuple(values[1:]),
        over_trainings=None,
        regions=regions,
    )
    trained = [regional.over_trainings for regional in group if regional.over_trainings is not None]
    if len(trained) == len(group):
        mean = mean_over_seeds(values, shared=average_shared([regional.shared for regional in trained]))
        return replace(joint, estimate=mean.as_estimate(), over_trainings=mean)
    return _widen(joint, graph.spreads.get(figure_key(joint)))


def _difference(
    graph: Graph, work: Path, after: tuple[str, str], before: tuple[str, str], region: str, task: str
) -> Difference:
    """Return the difference of two tests; `after` and `before` are arm and stage."""

    def folder(tested: tuple[str, str], repeat: int) -> Path:
        return work / test_folder(graph, name_repeat(tested[0], repeat), tested[1], region, task)

    def mean(tested: tuple[str, str], repeat: int) -> float:
        return Tested.load(folder(tested, repeat)).estimate.mean

    over_scenes = compare_tests(task, folder(before, 0), folder(after, 0), graph.recipe.seed)
    retrained = tuple(mean(after, n) - mean(before, n) for n in number_retrainings(graph))
    values = (over_scenes.mean, *retrained)
    folders = [(folder(after, n), folder(before, n)) for n in range(len(values))]
    trained = mean_over_trainings(task, over_scenes, values, folders, graph.recipe.seed, share=False)
    stages = [name_stage(_owner(graph, *at, region, task), at[1]) for at in (after, before)]
    name = f"{region}, {task}: {' - '.join(stages)}"
    found = Difference(name, *after, *before, region, task, over_scenes, over_scenes, measure_spread(values), retrained)
    if trained is not None:
        return replace(found, estimate=trained.as_estimate(), over_trainings=trained)
    return _widen(found, graph.spreads.get(figure_key(found)))


def _widen(found: Difference, known: Spread | None) -> Difference:
    """Widen the interval of a difference by its spread of retraining, or else by a `known` spread."""
    spread = found.spread or known
    return found if spread is None else replace(found, estimate=widen(found.over_scenes, spread), spread=spread)


def _owner(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the first of the arms that share this stage's step."""
    step = graph.names.stage(arm, stage, region, task)
    return next(name for name in graph.settings if graph.names.stage(name, stage, region, task) == step)


def compare_tests(task: str, before: Path, after: Path, seed: int) -> Estimate:
    """Return the paired difference `after` - `before` of the measure in two test folders, by bootstrap over scenes."""
    first, second = (Outcomes.load(folder / OUTCOMES) for folder in (before, after))
    return Estimate(*difference(task_named(task), first, second, seed))
