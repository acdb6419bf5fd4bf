"""Running a recipe, with one seed or several, and collecting the results of its steps."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict, Unpack

from flcav.config import InputError
from flcav.interface.notebook import resumable
from flcav.runs.analysis.collect import collect_results
from flcav.runs.analysis.histories import make_history_points
from flcav.runs.analysis.summary import summarise
from flcav.runs.arm_checks import check_federations
from flcav.runs.engine import Notify, Stale, Step, print_steps, run_side_by_side, run_steps, stopwatch
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


class RunOptions(TypedDict, total=False):
    """Keyword arguments of `run`, which describes them; their defaults are those of `_Terms`."""

    beside: Path | str | None
    jobs: int
    notify: Notify
    stale: Stale
    engine: str
    runtime: str
    fleet: Path | None


@dataclass(frozen=True)
class _Terms:
    """Processes, engine and folders in which the steps of a run are performed."""

    beside: Path | str | None = None
    jobs: int = 1
    notify: Notify = print_steps
    stale: Stale = "refuse"
    engine: str = "processes"
    runtime: str = "embedded"
    fleet: Path | None = None

    def read(self, recipe: RunRecipe) -> Graph:
        """Return the graph of a recipe's steps, whose federations are checked."""
        graph = Graph(recipe, Path(self.beside or "."))
        check_federations(recipe, graph.settings.values())
        return graph

    def deploy(self, graph: Graph) -> tuple[Step, ...]:
        """Return the steps of a graph, on vehicles of the fleet if the runtime has one."""
        return deploy(graph, self.runtime, self.fleet, self.engine)


@resumable
def run(recipe: RunRecipe | Path | str, out: Path | str, **options: Unpack[RunOptions]) -> Run:
    """Run or finish a recipe, or that in a YAML file, in the folder `out`; write its results there, and return them.

    The files are results.json, results.csv, history.csv, ledgers, rounds.parquet, and TensorBoard's event files.

    Args:
        recipe: of the run, or the path of its YAML file.
        out: folder of the run.
        options: by name, each with a default, see below.

    Options:
        beside: folder that towns, datasets and histories are looked for in; None, the default: the working directory.
        jobs: number of workers, of one thread each; 1 by default.
        notify: called with a step's name, its progress and a note, and with "" for that of all steps; by default a line
            of each finished step is printed.
        stale: what becomes of finished steps of other code or arguments: refuse (the default), redo or keep (see
            `run_steps`).
        engine: processes of this machine (the default), or ray: actors of a cluster.
        runtime: where vehicles train: embedded (the default), or flower: vehicles of a deployed fleet; the results are
            the same.
        fleet: folder of the fleet that is up; None, the default: one is brought up on this machine for each federation.

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
    terms, clock = _Terms(**options), stopwatch(out / WORK)
    graph = terms.read(recipe)
    tell_rigs([graph], terms.notify)

    def timed(step: str, done: int, total: int, note: str) -> None:
        if note == "done":
            clock()
        terms.notify(step, done, total, note)

    steps = terms.deploy(graph)
    run_steps(steps, out / WORK, jobs=terms.jobs, notify=timed, stale=terms.stale, engine=terms.engine)
    return _save_results(graph, out, out / HISTORY, clock(), f"seed{recipe.seed}")


def run_seeds(
    recipe: RunRecipe, out: Path | str, *, seeds: int, **options: Unpack[RunOptions]
) -> tuple[tuple[Run, ...], Summary]:
    """Run or finish a recipe with `seeds` consecutive seeds, from the recipe's; return all runs and their summary.

    A seed has a folder in `out`, next to summary.json and a common history.csv. Raises as `run`.

    Args:
        recipe: of the runs, but for their seeds.
        out: folder of all runs.
        seeds: number of runs.
        options: those of `run`.
    """
    recipes = {
        f"seed{seed}": recipe.model_copy(update={"seed": seed}) for seed in range(recipe.seed, recipe.seed + seeds)
    }
    runs = run_several(recipes, out, **options)
    summary = summarise(runs, [Path(out) / name / WORK for name in recipes])
    summary.save(out)
    return runs, summary


def run_several(recipes: Mapping[str, RunRecipe], out: Path | str, **options: Unpack[RunOptions]) -> tuple[Run, ...]:
    """Run or finish several recipes in parallel, in the folders of their names in `out`; return their results.

    They have a common history.csv in `out`; `options` are those of `run`.
    """
    terms, out = _Terms(**options), Path(out)
    graphs = {out / name: terms.read(recipe) for name, recipe in recipes.items()}
    tell_rigs(graphs.values(), terms.notify)
    steps = {folder / WORK: terms.deploy(graph) for folder, graph in graphs.items()}
    names = {folder / WORK: folder.name for folder in graphs}
    run_side_by_side(steps, jobs=terms.jobs, notify=terms.notify, stale=terms.stale, engine=terms.engine, names=names)
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
