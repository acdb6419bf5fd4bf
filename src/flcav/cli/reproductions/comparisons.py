"""Comparisons of `flcav reproduce` over seeds: each runs, or goes on, and writes its numbers and pictures."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flcav.cli.options import EngineName, Stale
from flcav.cli.reproductions.figures import write_figures
from flcav.cli.reproductions.targets import EXCHANGES, Target
from flcav.cli.terminal import echo, when_interrupted

if TYPE_CHECKING:
    from flcav.runs.recipe import RunRecipe
    from flcav.runs.results.run import Run

IMPORTED = "quarter"  # map of the package, imported into the folder of the proof of placement


def _demo_arms(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.arms.run import compare_arms, draw_arms, judge_differences
    from flcav.storage.files import write_bytes, write_json

    results = compare_arms(*_run_seeds(Target.demo_arms, "arms", out, seeds, scale, jobs, engine, stale))
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "arms.png", draw_arms(results))
    for arm, closed in results.summary.gap_closed.items():
        echo(f"{arm}: closes of the gap {closed.describe()}")
    if results.summary.road_share is not None:
        echo(f"share of the gain with an ideal road detector: {results.summary.road_share.describe()}")
    for name, judged in judge_differences(results.summary).items():
        echo(f"{name}: {results.summary.differences[name].describe(sign=True)}, {judged.verdict}: {judged.describe()}")


@when_interrupted()
def _fig6a_allocation(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.fig6a.run import BUDGETS, budget_recipes, compare_plans, draw_allocation, plans_differ
    from flcav.runs.running import run_several
    from flcav.storage.files import write_bytes, write_json

    recipe = _load_sized("allocation", scale)
    with live_steps(Target.fig6a_allocation.value) as notify:

        def finish(numbers: Sequence[int], factors: Sequence[float]) -> "dict[float, list[Run]]":
            recipes = budget_recipes(recipe, numbers, factors)
            runs = iter(run_several(recipes, out, jobs=jobs, notify=notify, stale=stale, engine=engine))
            return {factor: [next(runs) for _ in numbers] for factor in factors}

        first = finish([1], BUDGETS)
        others = finish(range(2, seeds + 1), [factor for factor, (run,) in first.items() if plans_differ(run)])
    results = compare_plans(recipe, {factor: [*own, *others.get(factor, [])] for factor, own in first.items()})
    write_json(out / "result.json", results.as_json())
    write_bytes(out / "plans.png", draw_allocation(results))
    for each in results.budgets:
        for finding in each.findings:
            echo(f"Budgets {each.name}. {finding.question} {finding.verdict}. {finding.sentence}")


def _distillation(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.distillation.run import compare_labels, draw_labels
    from flcav.experiments.scales import shrink_recipe

    own = _run_seeds(Target.distillation, "distillation", out, seeds, scale, jobs, engine, stale, shrink_recipe)
    results = compare_labels(*own)
    write_figures(out, results.as_json(), {"arms.png": draw_labels(results)}, results.sentences())


def _gap(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.gap.megabytes import trace_bytes
    from flcav.experiments.gap.run import TOWN, compare_gap, draw_gap, draw_megabytes
    from flcav.experiments.scales import shrink_recipe
    from flcav.runs.running import WORK

    recipe, runs = _run_seeds(Target.gap, "gap", out, seeds, scale, jobs, engine, stale, shrink_recipe)
    curves = [trace_bytes(run, out / f"seed{run.recipe.seed}" / WORK, TOWN) for run in runs]
    results = compare_gap(recipe, runs, curves)
    pictures = {"arms.png": draw_gap(results), "megabytes.png": draw_megabytes(results)}
    write_figures(out, results.as_json(), pictures, results.sentences())


@when_interrupted()
def _networks(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.networks.run import draw_networks, search_networks

    with live_steps(Target.networks.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        results = search_networks(out, seeds=range(1, seeds + 1), quick=scale != "paper", **how)
    write_figures(out, results.as_json(), {"networks.png": draw_networks(results)}, results.sentences())


@when_interrupted()
def _redundant_tasks(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.redundant_tasks.run import compare_splits

    with live_steps(Target.redundant_tasks.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        results = compare_splits(out, seeds=range(1, seeds + 1), quick=scale != "paper", **how)
    write_figures(out, results.as_json(), {"splits.png": results.picture()}, results.sentences())


def _federation_exchange(
    target: Target, out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale
) -> None:
    from flcav.experiments.exchanges.run import compare_exchanges, draw_results
    from flcav.experiments.scales import shrink_recipe

    recipe, runs = _run_seeds(target, EXCHANGES[target], out, seeds, scale, jobs, engine, stale, shrink_recipe)
    results = compare_exchanges(recipe, runs, [out / f"seed{run.recipe.seed}" for run in runs])
    write_figures(out, results.as_json(), {"exchange.png": draw_results(results)}, results.sentences())


def _placement(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.maps import import_map
    from flcav.experiments.placement.claims import describe_claims
    from flcav.experiments.placement.overlaps import describe_overlaps, list_overlaps
    from flcav.experiments.placement.run import draw_proof, list_regions, prove_placement
    from flcav.experiments.scales import shrink_recipe
    from flcav.runs.running import WORK

    asked = _load_sized("placement", scale, shrink_recipe)
    import_map(IMPORTED, out)
    overlaps = {region: list_overlaps(asked, region, out) for region in list_regions(asked)}
    for sentence in describe_overlaps(overlaps, asked.placement.range_m):
        echo(sentence)
    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe, out)
    recipe, runs = _run_seeds(Target.placement, "placement", out, *how)
    results = prove_placement(recipe, runs, [out / f"seed{run.recipe.seed}" / WORK for run in runs], out)
    write_figures(out, results.as_json(), draw_proof(results), [*results.sentences(), *describe_claims(results)])


@when_interrupted()
def _safety_distance(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.safety_distance.run import SCENARIOS, compare_margins
    from flcav.interface import progress

    with progress.show_progress(Target.safety_distance.value) as report:
        results = compare_margins(out, seeds, jobs, report, SCENARIOS if scale == "paper" else 2)
    write_figures(out, results.as_json(), {"trade_off.png": results.picture()}, results.sentences())


@when_interrupted()
def _failure_search(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.failure_search.run import SCENARIOS, compare_searches
    from flcav.interface import progress

    with progress.show_progress(Target.failure_search.value) as report:
        results = compare_searches(out, seeds, SCENARIOS if scale == "paper" else 4, report)
    write_figures(out, results.as_json(), {"growth.png": results.picture()}, results.sentences())


def _corner_cases(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.corner_cases.run import compare_corner_cases, draw_corner_cases
    from flcav.experiments.scales import shrink_recipe
    from flcav.interface import progress
    from flcav.runs.running import WORK

    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe)
    recipe, runs = _run_seeds(Target.corner_cases, "corner_cases", out, *how)
    works = [out / f"seed{run.recipe.seed}" / WORK for run in runs]
    with progress.show_progress("rare kinds") as report:
        results = compare_corner_cases(recipe, runs, works, report)
    write_figures(out, results.as_json(), {"arms.png": draw_corner_cases(results)}, results.sentences())


def _lifelong(out: Path, seeds: int, scale: str, jobs: int, engine: EngineName, stale: Stale) -> None:
    from flcav.experiments.lifelong.run import compare_lifelong, draw_lifelong
    from flcav.experiments.scales import shrink_recipe

    how: Any = (seeds, scale, jobs, engine, stale, shrink_recipe)
    results = compare_lifelong(*_run_seeds(Target.lifelong, "lifelong", out, *how))
    write_figures(out, results.as_json(), {"lifelong.png": draw_lifelong(results)}, results.sentences())


COMPARISONS: Mapping[str, Callable[[Path, int, str, int, EngineName, Stale], None]] = {
    Target.corner_cases: _corner_cases,
    Target.demo_arms: _demo_arms,
    Target.distillation: _distillation,
    **{target: partial(_federation_exchange, Target(target)) for target in EXCHANGES},
    Target.failure_search: _failure_search,
    Target.fig6a_allocation: _fig6a_allocation,
    Target.gap: _gap,
    Target.lifelong: _lifelong,
    Target.networks: _networks,
    Target.placement: _placement,
    Target.redundant_tasks: _redundant_tasks,
    Target.safety_distance: _safety_distance,
}


@when_interrupted()
def _run_seeds(
    target: Target,
    name: str,
    out: Path,
    seeds: int,
    scale: str,
    jobs: int,
    engine: EngineName,
    stale: Stale,
    shrink: "Callable[[RunRecipe], RunRecipe] | None" = None,
    beside: Path | None = None,
) -> "tuple[RunRecipe, tuple[Run, ...]]":
    """Run or finish the package's recipe `runs/<name>` with several seeds, as `_load_sized` returns it.

    Imported towns are looked for in `beside`.
    """
    from flcav.cli.steps import live_steps
    from flcav.runs.running import run_seeds

    recipe = _load_sized(name, scale, shrink)
    with live_steps(target.value) as notify:
        how: Any = {"jobs": jobs, "notify": notify, "stale": stale, "engine": engine}
        runs, _ = run_seeds(recipe, out, seeds=seeds, beside=beside, **how)
    return recipe, runs


def _load_sized(name: str, scale: str, shrink: "Callable[[RunRecipe], RunRecipe] | None" = None) -> "RunRecipe":
    """Return the package's recipe `runs/<name>`; unless scale is paper, `shrink` of it (None: at the demo's size)."""
    from flcav.experiments.scales import use_demo_size
    from flcav.runs.recipe import load_run_recipe
    from flcav.sources.recipe import recipe_path

    recipe = load_run_recipe(recipe_path(f"runs/{name}"))
    return recipe if scale == "paper" else (shrink or use_demo_size)(recipe)
