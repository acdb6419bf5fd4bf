"""Running a recipe, with one seed or several, and collecting the results of its steps."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from flcav.config import InputError
from flcav.interface.notebook import resumable
from flcav.runs.analysis.collect import collect_results
from flcav.runs.analysis.histories import make_history_points
from flcav.runs.analysis.summary import summarise
from flcav.runs.arms import check_federations
from flcav.runs.engine import Notify, Stale, print_steps, run_side_by_side, run_steps, stopwatch
from flcav.runs.recipe import RunRecipe, load_run_recipe
from flcav.runs.results.run import Run, Summary
from flcav.runs.results.table import save_table
from flcav.runs.rigs import tell_rigs
from flcav.runs.spread import list_spreads
from flcav.runs.stages.deployment import deploy
from flcav.runs.stages.graph import Graph
from flcav.runs.tables import append_records
from flcav.runs.training.records import write_rounds

WORK, HISTORY, SPREAD = "work", "history.csv", "spread.csv"
RESULTS = Run.file


@resumable
def run(
    recipe: RunRecipe | Path | str,
    out: Path | str,
    *,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = print_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
    runtime: str = "embedded",
    fleet: Path | None = None,
) -> Run:
    """Run or finish a recipe, or that in a YAML file, in the folder `out`; write its results there, and return them.

    The files are results.json, results.csv, history.csv, ledgers, rounds.parquet, and TensorBoard's event files.

    Args:
        recipe: of the run, or the path of its YAML file.
        out: folder of the run.
        beside: folder that towns, datasets and histories are looked for in; None: the working directory.
        jobs: number of workers, of one thread each.
        notify: called with a step's name, its progress and a note.
        stale: what becomes of finished steps of other code or arguments: refuse, redo or keep (see `run_steps`).
        engine: processes of this machine, or ray: actors of a cluster.
        runtime: where vehicles train: embedded, or flower: vehicles of a deployed fleet; the results are the same.
        fleet: folder of the fleet that is up; None: one is brought up on this machine for each federation.

    Raises `InputError` where a part of the recipe cannot be used, and where `out` holds another run or, if `stale`
    refuses that, one of other code.

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
    out, recipe = Path(out), recipe if isinstance(recipe, RunRecipe) else load_run_recipe(recipe)
    if (out / RESULTS).exists():
        Run.load(out)  # raises for results of another version
    graph, clock = Graph(recipe, Path(beside or ".")), stopwatch(out / WORK)
    check_federations(recipe, graph.settings.values())
    tell_rigs([graph], notify)

    def timed(step: str, done: int, total: int, note: str) -> None:
        if note == "done":
            clock()
        notify(step, done, total, note)

    steps = deploy(graph, runtime, fleet, engine)
    run_steps(steps, out / WORK, jobs=jobs, notify=timed, stale=stale, engine=engine)
    return _save_results(graph, out, out / HISTORY, clock(), f"seed{recipe.seed}")


def run_seeds(
    recipe: RunRecipe,
    out: Path | str,
    *,
    seeds: int,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = print_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
    runtime: str = "embedded",
    fleet: Path | None = None,
) -> tuple[tuple[Run, ...], Summary]:
    """Run or finish a recipe with `seeds` consecutive seeds, from the recipe's; return all runs and their summary.

    A seed has a folder in `out`, next to summary.json and a common history.csv. Raises as `run`.

    Args:
        recipe: of the runs, but for their seeds.
        out: folder of all runs.
        seeds: number of runs.
        beside: folder that towns, datasets and histories are looked for in; None: the working directory.
        jobs: number of workers, of one thread each.
        notify: called with a step's name, its progress and a note.
        stale: what becomes of finished steps of other code or arguments: refuse, redo or keep (see `run_steps`).
        engine: processes of this machine, or ray: actors of a cluster.
        runtime: where vehicles train: embedded, or flower: vehicles of a deployed fleet; the results are the same.
        fleet: folder of the fleet that is up; None: one is brought up on this machine for each federation.
    """
    recipes = {
        f"seed{seed}": recipe.model_copy(update={"seed": seed}) for seed in range(recipe.seed, recipe.seed + seeds)
    }
    where = {"engine": engine, "runtime": runtime, "fleet": fleet}
    runs = run_several(recipes, out, beside=beside, jobs=jobs, notify=notify, stale=stale, **where)
    summary = summarise(runs, [Path(out) / name / WORK for name in recipes])
    summary.save(out)
    return runs, summary


def run_several(
    recipes: Mapping[str, RunRecipe],
    out: Path | str,
    *,
    beside: Path | str | None = None,
    jobs: int = 1,
    notify: Notify = print_steps,
    stale: Stale = "refuse",
    engine: str = "processes",
    runtime: str = "embedded",
    fleet: Path | None = None,
) -> tuple[Run, ...]:
    """Run or finish several recipes in parallel, in the folders of their names in `out`; return their results.

    They have a common history.csv in `out`. Other arguments are those of `run`.
    """
    out = Path(out)
    graphs = {out / name: Graph(recipe, Path(beside or ".")) for name, recipe in recipes.items()}
    for graph in graphs.values():
        check_federations(graph.recipe, graph.settings.values())
    tell_rigs(graphs.values(), notify)
    steps = {folder / WORK: deploy(graph, runtime, fleet, engine) for folder, graph in graphs.items()}
    names = {folder / WORK: folder.name for folder in graphs}
    run_side_by_side(steps, jobs=jobs, notify=notify, stale=stale, engine=engine, names=names)
    return tuple(_save_results(graph, folder, out / HISTORY, 0.0, folder.name) for folder, graph in graphs.items())


def _save_results(graph: Graph, out: Path, history: Path, elapsed_s: float, name: str) -> Run:
    """Collect the results of finished steps, write them to `out`, and add their points to the history."""
    result = replace(collect_results(graph, out / WORK), elapsed_s=round(elapsed_s, 1))
    append_records(history, make_history_points(result, name))
    if graph.recipe.retrainings:
        append_records(history.with_name(SPREAD), list_spreads(result, name))
    write_rounds(result, out)
    save_table(result, out)
    result.save(out)
    return result


def seed_folders(folder: Path) -> dict[int, Path]:
    """Return the folders of a run, or of its seeds, by seed; raises `InputError` where there is no finished run."""
    candidates = [folder] if (folder / RESULTS).is_file() else sorted(folder.glob("seed*"))
    found = {Run.load(candidate).recipe.seed: candidate for candidate in candidates if (candidate / RESULTS).is_file()}
    if not found:
        raise InputError(f"{folder}: no finished run, it has no {RESULTS}")
    return found
