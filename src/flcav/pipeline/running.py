"""Running a recipe, with one seed or several, and collecting the results of its steps."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from flcav.config import InputError
from flcav.intervals import Estimate, measure_spread, widen, widen_share
from flcav.network.ledger import LINKS, Budget, Ledger
from flcav.perception.outcomes import Outcomes, difference
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import Setting, check_federations, name_repeat
from flcav.pipeline.federations.records import save_rounds
from flcav.pipeline.findings import findings, name_stage
from flcav.pipeline.graph import Graph
from flcav.pipeline.labels import LABEL_SOURCES
from flcav.pipeline.planning import HistoryPoint
from flcav.pipeline.provenance import provenance
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.pipeline.results import (
    LEDGER,
    OUTCOMES,
    ArmResult,
    Difference,
    LinkUse,
    Placed,
    Plan,
    Pretrained,
    RegionalTest,
    Run,
    Spent,
    StageResult,
    Summary,
    Test,
    Tested,
    Watched,
    average_regions,
)
from flcav.pipeline.seeds.spread import difference_key, list_spreads, test_key
from flcav.pipeline.seeds.summary import summarise
from flcav.pipeline.steps import Notify, Stale, ignore_steps, run_side_by_side, run_steps, stopwatch
from flcav.pipeline.tables import append_records

WORK, RESULTS, SUMMARY, HISTORY, SPREAD = "work", "results.json", "summary.json", "history.csv", "spread.csv"


def run(
    recipe: RunRecipe,
    out: Path | str,
    *,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = ignore_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
) -> Run:
    """Run or finish a recipe in the folder `out`; write its results there, and return them.

    The files are results.json, history.csv, ledgers, rounds.parquet, and TensorBoard's event files.

    Towns, datasets and histories are looked for in `beside` (None: the working directory). `jobs` workers compute, of
    one thread each; `engine` and `stale` are those of `run_steps`. Raises `InputError` where a part of the recipe
    cannot be used, and where `out` holds another run or, if `stale` refuses that, one of other code.

    >>> import flcav
    >>> few = {"scenes": 2, "spins": 1, "cavs": 1}
    >>> recipe = flcav.RunRecipe.model_validate({
    ...     "splits": dict.fromkeys(("pool", "validation", "registry", "edge", "test"), few),
    ...     "training": {"steps": 1, "local_steps": 1},
    ...     "tasks": {"weather": {"plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 1}}},
    ...     "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate"}},
    ...     "budgets_mb": {"wireless": 9, "wireline": 9},
    ...     "placement": {"rule": "none"},
    ...     "recording": {"warmup_s": 5.0, "weather": "clear"},
    ... })
    >>> result = flcav.run(recipe, "out/run")
    >>> test = result.test(stage="cloud", region="ring", task="weather")
    >>> test.measure, test.frames, result.arms["main"].links["wireless"].used_mb < 9
    ('accuracy', 2, True)
    """
    out = Path(out)
    if (out / RESULTS).exists():
        Run.load(out, RESULTS)  # raises for results of another version
    graph, clock = Graph(recipe, Path(beside or ".")), stopwatch(out / WORK)
    check_federations(recipe, graph.settings.values())

    def timed(step: str, done: int, total: int, note: str) -> None:
        if note == "done":
            clock()
        notify(step, done, total, note)

    run_steps(graph.steps, out / WORK, jobs=jobs, notify=timed, stale=stale, engine=engine)
    return _save_results(graph, out, out / HISTORY, clock(), f"seed{recipe.seed}")


def run_seeds(
    recipe: RunRecipe,
    out: Path | str,
    *,
    seeds: int,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = ignore_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
) -> tuple[tuple[Run, ...], Summary]:
    """Run or finish a recipe with `seeds` consecutive seeds, its own first; return all runs and their summary.

    Each seed has a folder in `out`, beside summary.json and a common history.csv. Other arguments are those of `run`.
    """
    recipes = {
        f"seed{seed}": recipe.model_copy(update={"seed": seed}) for seed in range(recipe.seed, recipe.seed + seeds)
    }
    runs = run_several(recipes, out, beside=beside, jobs=jobs, notify=notify, stale=stale, engine=engine)
    summary = summarise(runs, [Path(out) / name / WORK for name in recipes])
    summary.save(Path(out), SUMMARY)
    return runs, summary


def run_several(
    recipes: Mapping[str, RunRecipe],
    out: Path | str,
    *,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = ignore_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
) -> tuple[Run, ...]:
    """Run or finish several recipes side by side, each in the folder of its name in `out`; return their results.

    They have a common history.csv in `out`. Other arguments are those of `run`.
    """
    out = Path(out)
    graphs = {out / name: Graph(recipe, Path(beside or ".")) for name, recipe in recipes.items()}
    for graph in graphs.values():
        check_federations(graph.recipe, graph.settings.values())
    steps = {folder / WORK: graph.steps for folder, graph in graphs.items()}
    names = {folder / WORK: folder.name for folder in graphs}
    run_side_by_side(steps, jobs=jobs, notify=notify, stale=stale, engine=engine, names=names)
    return tuple(_save_results(graph, folder, out / HISTORY, 0.0, folder.name) for folder, graph in graphs.items())


def _save_results(graph: Graph, out: Path, history: Path, elapsed_s: float, name: str) -> Run:
    """Collect the results of finished steps, write them to `out`, and add their points to the history."""
    result = replace(collect_results(graph, out / WORK), elapsed_s=round(elapsed_s, 1))
    append_records(history, make_history_points(result, name))
    if graph.recipe.retrainings:
        append_records(history.with_name(SPREAD), list_spreads(result, name))
    save_rounds(result, out)
    result.save(out, RESULTS)
    return result


def seed_folders(folder: Path) -> dict[int, Path]:
    """Return the folders of a run, or of each of its seeds, by seed; raises `InputError` where there is no run."""
    own = [folder] if (folder / RESULTS).is_file() else sorted(folder.glob("seed*"))
    found = {Run.load(each, RESULTS).recipe.seed: each for each in own if (each / RESULTS).is_file()}
    if not found:
        raise InputError(f"{folder}: no finished run, it has no {RESULTS}")
    return found


def collect_results(graph: Graph, work: Path) -> Run:
    """Collect the results of the finished steps in `work`, and write each arm's ledger to `ledgers` beside it."""
    recipe, names, main = graph.recipe, graph.names, graph.settings[MAIN]
    settings = {name: setting for name, setting in graph.settings.items() if not setting.repeat}
    tests = [
        _test(graph, work, arm.name, stage, region, task)
        for arm in settings.values()
        for stage, region, task in graph.tested(arm)
    ]
    watched = [
        Watched.load(work / names.rounds(names.stage(MAIN, stage, region, task), region))
        for stage, region, task in graph.watched()
    ]
    arms = {name: _arm(graph, work, arm) for name, arm in settings.items()}
    differences = _differences(graph, work)
    rules = {name: arm.placement.rule for name, arm in settings.items()}
    roles = {name: region.role for name, region in recipe.regions.items()}
    rests = {task: LABEL_SOURCES[kind].caveat for task, kind in main.labels.items()}
    return Run(
        recipe=recipe,
        arms=arms,
        pretrained=tuple(Pretrained.load(work / names.pretrain(MAIN, task)) for task in recipe.tasks),
        watched=tuple(watched),
        tested=tuple(tests),
        differences=tuple(differences),
        findings=findings(differences, tests, arms, rules, roles, rests),
        gap_closed=gaps_closed(tests, recipe),
        provenance=provenance(recipe.seed),
        caveats=tuple(dict.fromkeys(filter(None, rests.values()))),
    )


def _test(graph: Graph, work: Path, arm: str, stage: str, region: str, task: str) -> Test:
    step = test_folder(graph, arm, stage, region, task)
    result = Tested.load(work / step)
    again = [test_folder(graph, name_repeat(arm, n), stage, region, task) for n in _retrainings(graph)]
    retrained = tuple(Tested.load(work / each).estimate.mean for each in again)
    spread = measure_spread((result.estimate.mean, *retrained)) or graph.spreads.get(test_key(task, region, arm, stage))
    estimate = result.estimate if spread is None else widen_share(result.estimate, spread)
    return Test(arm, stage, region, task, step, result, estimate, spread, retrained)


def _retrainings(graph: Graph) -> range:
    return range(1, 1 + graph.recipe.retrainings)


def test_folder(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the name of the step, and of its folder, that tested an arm's network after a stage."""
    return graph.names.test(graph.names.stage(arm, stage, region, task), region)


def _arm(graph: Graph, work: Path, arm: Setting) -> ArmResult:
    names, tasks = graph.names, graph.recipe.tasks
    plans = dict.fromkeys(names.plan(arm.name, stage) for stage in (PRETRAIN, *arm.stages))
    *earlier, plan = (Plan.load(work / name) for name in plans)
    trained = [
        names.stage(arm.name, stage, region, task)
        for task in tasks
        for stage in arm.stages
        for region in (arm.regions if stage != CLOUD else arm.regions[:1])
    ]
    books = [Ledger.load(work / names.pretrain(arm.name, task) / LEDGER) for task in tasks]
    if arm.stages != (CENTRAL,):
        last = names.more_edge if MORE_EDGE in arm.stages else names.edge
        books += [Ledger.load(work / last(arm.name, region, task) / LEDGER) for task in tasks for region in arm.regions]
    if CLOUD in arm.stages:
        books = [Ledger.load(work / names.cloud(arm.name, task) / LEDGER) for task in tasks]  # they include the others
    budgets = graph.recipe.budgets_mb
    book = Ledger(Budget(budgets.wireless, budgets.wireline), (entry for each in books for entry in each.entries))
    book.save(work.parent / "ledgers" / f"{arm.name}.parquet")
    stages = tuple(StageResult.load(work / step) for step in trained)
    ended = {each.task: each.plans[-1].plan for each in stages if each.stage == CLOUD and each.plans}
    plan = replace(plan, tasks={**plan.tasks, **ended})
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
        regional=_regional_tests(graph, work, arm) or None,
    )


def _regional_tests(graph: Graph, work: Path, arm: Setting) -> tuple[RegionalTest, ...]:
    found = []
    for stage, region, task in graph.tested(arm):
        trained = graph.names.stage(arm.name, stage, region, task)
        for model in graph.models(arm, stage):
            if model is not None:
                tested = Tested.load(work / graph.names.test(trained, region, model))
                found.append(RegionalTest(model, region, task, tested.measure, tested.estimate))
    return tuple(found)


def _differences(graph: Graph, work: Path) -> list[Difference]:
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
    retrained = tuple(mean(after, n) - mean(before, n) for n in _retrainings(graph))
    spread = measure_spread((over_scenes.mean, *retrained))
    told = [name_stage(_owner(graph, *each, region, task), each[1]) for each in (after, before)]
    name = f"{region}, {task}: {' - '.join(told)}"
    found = Difference(name, *after, *before, region, task, over_scenes, over_scenes, spread, retrained)
    spread = spread or graph.spreads.get(difference_key(found))
    return found if spread is None else replace(found, estimate=widen(over_scenes, spread), spread=spread)


def _owner(graph: Graph, arm: str, stage: str, region: str, task: str) -> str:
    """Return the first of the arms that share this stage's step."""
    step = graph.names.stage(arm, stage, region, task)
    return next(name for name in graph.settings if graph.names.stage(name, stage, region, task) == step)


def compare_tests(task: str, before: Path, after: Path, seed: int) -> Estimate:
    """Return the paired difference `after` - `before` of two test folders' measure, by bootstrap over scenes."""
    first, second = (Outcomes.load(folder / OUTCOMES) for folder in (before, after))
    return Estimate(*difference(task_named(task), first, second, seed))


def gap_closed(start: float, reached: float, end: float) -> float:
    """Return the fraction (reached - start) / (end - start) of a gap that was closed; 0 where there is no gap."""
    return (reached - start) / (end - start) if end != start else 0.0


def gaps_closed(tests: Sequence[Test], recipe: RunRecipe) -> dict[str, float]:
    """Return the fraction of the gap from pretraining to centralised training that each stage closes, by its name.

    The reference trains on the region's own ground truth; regions without such an arm are left out.
    """
    values = {(test.arm, test.stage, test.region, test.task): test.result.estimate.mean for test in tests}
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
                points.append(HistoryPoint(task, own.samples, *counts, at.score, frames, run))
    return points
