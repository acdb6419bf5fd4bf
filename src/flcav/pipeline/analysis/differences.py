"""Paired differences of a run's tests: between stages, and between the run and its arms."""

from dataclasses import replace
from pathlib import Path

from flcav.perception.outcomes import Outcomes, difference
from flcav.perception.tasks import task_named
from flcav.pipeline.analysis.findings import name_stage
from flcav.pipeline.analysis.tests import mean_over_trainings, number_retrainings, test_folder
from flcav.pipeline.arms import name_repeat
from flcav.pipeline.graph.graph import Graph
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.pipeline.results.saved import OUTCOMES
from flcav.pipeline.results.tests import Difference, Tested
from flcav.pipeline.spread import difference_key
from flcav.statistics.estimates import Estimate, measure_spread, widen


def list_differences(graph: Graph, work: Path) -> list[Difference]:
    """Return each stage minus the one before it, and the run itself minus each other arm at the same stage."""
    main = graph.settings[MAIN]
    pairs: list[tuple[tuple[str, str], tuple[str, str], str, str]] = []
    for arm in graph.settings.values():
        for stage, region, task in () if arm.repeat else graph.tested(arm):
            if stage != PRETRAIN:
                earlier = EDGE if stage in (CLOUD, MORE_EDGE) and region in arm.regions else PRETRAIN
                pairs.append(((arm.name, stage), (arm.name, earlier), region, task))
            if arm.name != MAIN and (region in main.regions or stage != EDGE):
                own = {CENTRAL: EDGE, MORE_EDGE: CLOUD}.get(stage, stage)
                pairs.append(((MAIN, own), (arm.name, stage), region, task))
    found: dict[tuple[str, str], Difference] = {}
    for after, before, region, task in pairs:
        steps = test_folder(graph, *after, region, task), test_folder(graph, *before, region, task)
        if steps[0] != steps[1] and steps not in found:
            found[steps] = _difference(graph, work, after, before, region, task)
    return list(found.values())


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
    told = [name_stage(_owner(graph, *each, region, task), each[1]) for each in (after, before)]
    name = f"{region}, {task}: {' - '.join(told)}"
    found = Difference(name, *after, *before, region, task, over_scenes, over_scenes, measure_spread(values), retrained)
    if trained is not None:
        return replace(found, estimate=trained.as_estimate(), over_trainings=trained)
    spread = found.spread or graph.spreads.get(difference_key(found))
    return found if spread is None else replace(found, estimate=widen(over_scenes, spread), spread=spread)


def _owner(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the first of the arms that share this stage's step."""
    step = graph.names.stage(arm, stage, region, task)
    return next(name for name in graph.settings if graph.names.stage(name, stage, region, task) == step)


def compare_tests(task: str, before: Path, after: Path, seed: int) -> Estimate:
    """Return the paired difference `after` - `before` of two test folders' measure, by bootstrap over scenes."""
    first, second = (Outcomes.load(folder / OUTCOMES) for folder in (before, after))
    return Estimate(*difference(task_named(task), first, second, seed))
