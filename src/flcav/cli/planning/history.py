"""`flcav history`: measure the learning history of a task, by runs with different numbers of samples."""

from pathlib import Path

import typer

from flcav.cli.options import ENGINE, JOBS, STALE, EngineName, Stale
from flcav.cli.terminal import echo, only_writer_of, when_interrupted
from flcav.config import InputError
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads


@when_interrupted()
@only_writer_of("out")
def history(
    recipe: Path = typer.Argument(help="Run recipe (YAML) with the towns, sizes and training of the history."),
    task: str = typer.Option(..., "--task", help="A task of the recipe."),
    samples: str = typer.Option(..., "--samples", help="Numbers of uploaded samples: 40,80,160,320."),
    edge_rounds: int = typer.Option(8, "--edge-rounds", min=0, help="Edge rounds of every run."),
    cloud_rounds: int = typer.Option(4, "--cloud-rounds", min=0, help="Cloud rounds of every run."),
    seeds: int = typer.Option(3, "--seeds", min=1, help="Number of seeds, each with a run per number of samples."),
    first_seed: int = typer.Option(
        101, "--first-seed", min=0, help="The first seed; take others than those of the runs to be planned."
    ),
    out: Path = typer.Option(..., "--out", help="Folder of the runs; the same command goes on after a stop."),
    jobs: int = JOBS,
    engine: EngineName = ENGINE,
    stale: Stale = STALE,
) -> None:
    """Measure the learning history of a task; write history.csv, and its origin to history.json.

    A recipe's `history:` names the table; `flcav fit` fits curves to it.
    """
    use_threads(1)
    from flcav.cli.steps import live_steps
    from flcav.runs.analysis.histories import history_recipes, save_origin
    from flcav.runs.recipe import load_run_recipe
    from flcav.runs.running import HISTORY, run_several
    from flcav.sources.recipe import find_recipe
    from flcav.storage.files import check_writable

    counts = _parse_counts(samples)
    check_writable(out)
    found = find_recipe(recipe)
    loaded = load_run_recipe(found)
    recipes = history_recipes(loaded, task, counts, edge_rounds, cloud_rounds, range(first_seed, first_seed + seeds))
    with live_steps("history") as notify:
        runs = run_several(
            recipes, out, beside=found.parent, jobs=jobs, notify=notify, stale=stale.value, engine=engine.value
        )
    save_origin(loaded, task, runs, out)
    echo(f"{out / HISTORY}: {plural(len(runs), 'run')}; next: flcav fit {out / HISTORY}")


def _parse_counts(text: str) -> tuple[int, ...]:
    """Return the whole numbers in a comma-separated list, sorted; raises `InputError` for other text."""
    try:
        counts = tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        counts = ()
    if not counts or counts[0] < 1:
        raise InputError(f"--samples '{text}': whole numbers from 1 are wanted, with commas between them: 40,80,160")
    return counts
