"""Assembly of a run's results from its finished steps."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from flcav.network.ledger import LINKS, Ledger, LinkMegabytes
from flcav.perception.tasks import task_named
from flcav.runs.analysis.caveats import list_caveats, list_cut, list_diverged, list_unreached
from flcav.runs.analysis.costs import collect_home_costs, list_arm_costs
from flcav.runs.analysis.differences import (
    collect_regional_tests,
    collect_test,
    count_found,
    list_differences,
    number_retrainings,
)
from flcav.runs.analysis.findings import findings
from flcav.runs.analysis.histories import gaps_closed
from flcav.runs.arms import Setting, name_repeat
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.provenance import provenance
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.runs.registry import RESULTS, load_all
from flcav.runs.results.plans import Placed, Plan
from flcav.runs.results.run import ArmResult, LinkUse, Run, Spent
from flcav.runs.results.saved import LEDGER
from flcav.runs.results.training import Pretrained, StageResult, Watched
from flcav.runs.rigs import compare_rigs
from flcav.runs.stages.centralised import COUNTED_MB
from flcav.runs.stages.graph import Graph
from flcav.runs.training.private_rounds import PrivateTraining, compose_trainings, count_private_rounds


def collect_results(graph: Graph, work: Path) -> Run:
    """Collect the results of the finished steps in `work`; writes the arms' ledgers to `ledgers` next to it."""
    recipe, names, main = graph.recipe, graph.names, graph.settings[MAIN]
    settings = {name: setting for name, setting in graph.settings.items() if not setting.repeat}
    tests = [
        collect_test(graph, work, arm.name, stage, region, task)
        for arm in settings.values()
        for stage, region, task in graph.tested(arm)
    ]
    watched = [
        Watched.load(work / names.rounds(names.stage(MAIN, stage, region, task), region))
        for stage, region, task in graph.watched()
    ]
    arms = {name: _arm(graph, work, arm) for name, arm in settings.items()}
    differences = list_differences(graph, work)
    rests = {task: LABEL_SOURCES[kind].caveat for task, kind in main.labels.items()}
    run = Run(
        recipe=recipe,
        arms=arms,
        pretrained=tuple(Pretrained.load(work / names.pretrain(MAIN, task)) for task in recipe.tasks),
        watched=tuple(watched),
        tested=tuple(tests),
        differences=tuple(differences),
        findings=findings(differences, tests, arms, settings, recipe, rests),
        gap_closed=gaps_closed(tests, recipe),
        provenance=provenance(recipe.seed),
        home=collect_home_costs(graph, work) or None,
        counts=tuple(count for test in tests if (count := count_found(work, test)) is not None) or None,
        **{name: row for collect in load_all(RESULTS) for name, row in collect(graph, work).items()},
        caveats=(
            *list_caveats(recipe, main.labels.values(), settings.values()),
            *list_unreached(arms, settings, recipe.placement.group_range_m),
            *list_cut(arms, settings),
            *list_diverged(arms),
            *compare_rigs(graph),
        ),
    )
    return replace(run, costs=list_arm_costs(run) or None)


def _arm(graph: Graph, work: Path, arm: Setting) -> ArmResult:
    names = graph.names
    tasks = graph.recipe.tasks
    plans = dict.fromkeys(names.plan(arm.name, stage) for stage in (PRETRAIN, *arm.stages))
    *earlier, plan = (Plan.load(work / name) for name in plans)
    trained = dict.fromkeys(
        names.stage(arm.name, stage, region, task) for task in tasks for stage in arm.stages for region in arm.regions
    )
    books = [Ledger.load(work / names.pretrain(arm.name, task) / LEDGER) for task in tasks]
    if arm.uploads is not None:
        books += [Ledger.load(work / step / LEDGER) for step in trained]
    if arm.stages != (CENTRAL,):
        last = names.more_edge if MORE_EDGE in arm.stages else names.edge
        books += [Ledger.load(work / last(arm.name, region, task) / LEDGER) for task in tasks for region in arm.regions]
    if CLOUD in arm.stages:
        books = [Ledger.load(work / names.cloud(arm.name, task) / LEDGER) for task in tasks]  # they include the others
    budgets = graph.recipe.budgets_mb
    wireline = budgets.wireline if arm.uploads is None else COUNTED_MB  # as when they were sent
    book = Ledger(LinkMegabytes(budgets.wireless, wireline), (entry for ledger in books for entry in ledger.entries))
    book.save(work.parent / "ledgers" / f"{arm.name}.parquet")
    stages = tuple(StageResult.load(work / step) for step in trained)
    return ArmResult(
        plan=plan,
        placed=tuple(Placed.load(work / names.place(arm.name, region)) for region in arm.regions),
        stages=stages,
        links={
            link: LinkUse(
                getattr(budgets, link),
                sum(getattr(task, f"{link}_mb") for task in plan.tasks.values()),
                book.used_mb(link),
            )
            for link in LINKS
        },
        spent=tuple(
            Spent(stage, task, link, book.used_mb(link, stage=stage, task=task_named(task).name))
            for task in tasks
            for stage in (PRETRAIN, EDGE, CLOUD)
            for link in LINKS
        ),
        earlier=tuple(earlier) or None,
        regional=collect_regional_tests(graph, work, arm) or None,
        retrained=_retrained(graph, work, arm) if CLOUD in arm.stages else None,
        privacy=None if arm.central else compose_trainings(arm.federation, list_trainings(graph, work, arm)),
    )


def list_trainings(graph: Graph, work: Path, arm: Setting) -> Iterator[PrivateTraining]:
    """Yield the trainings of every task with a region's vehicles, including an arm's retrainings."""
    for name in (name_repeat(arm.name, number) for number in (0, *number_retrainings(graph))):
        for region in arm.regions:
            for task in graph.recipe.tasks:
                stages = {
                    stage: StageResult.load(work / graph.names.stage(name, stage, region, task)) for stage in arm.stages
                }
                rounds = count_private_rounds(arm.federation, stages, region)
                yield PrivateTraining(region, stages[EDGE].clients, rounds, stages[EDGE].noise)


def _retrained(graph: Graph, work: Path, arm: Setting) -> tuple[StageResult, ...] | None:
    """Return stage III of every task in an arm's retrainings; None where there are none."""
    arms = [name_repeat(arm.name, number) for number in number_retrainings(graph)]
    steps = [graph.names.cloud(name, task) for name in arms for task in graph.recipe.tasks]
    return tuple(StageResult.load(work / step) for step in steps) or None
