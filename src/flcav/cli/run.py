"""`flcav run`, `flcav demo`, `flcav compare`: run a recipe through the three stages, and compare two runs."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flcav.cli.options import AGENTS, ENGINE, FLEET, JOBS, STALE, EngineName, Runtime, Stale, refuse_unused
from flcav.cli.terminal import echo, only_writer_of, print_json, when_interrupted
from flcav.config import InputError
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.runs.results.run import Run, Summary


RUNTIME = typer.Option(
    Runtime.embedded, "--runtime", help="Where vehicles train: embedded: processes here; flower: a deployed fleet."
)
SEEDS = typer.Option(1, "--seeds", min=1, help="Number of seeds, from the recipe's on; above 1, a folder each.")
DRY = typer.Option(False, "--dry", help="Say what the run would take, and do nothing of it.")
AS_JSON = typer.Option(False, "--json", help="Print one JSON object instead of sentences.")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(run)
    app.command()(demo)
    app.command()(compare)


@when_interrupted()
@only_writer_of("out")
def run(
    recipe: Path = typer.Argument(help="Run recipe (YAML): tasks, regions, budgets, arms; see docs/runs.md."),
    out: Path | None = typer.Option(None, "--out", help="Folder of the run; the same command goes on after a stop."),
    dry: bool = DRY,
    jobs: int = JOBS,
    seeds: int = SEEDS,
    engine: EngineName = ENGINE,
    runtime: Runtime = RUNTIME,
    fleet: Path | None = FLEET,
    stale: Stale = STALE,
    as_json: bool = AS_JSON,
) -> None:
    """Run a recipe through the three stages; write report.html, results.json and history.csv."""
    if runtime is not Runtime.flower:
        refuse_unused(f"--runtime {runtime.value}", "fleet")
    if dry:
        _forecast(recipe, as_json)
    elif out is None:
        raise InputError("--out is missing: the folder of the run; --dry says what it would take")
    else:
        how = {"jobs": jobs, "stale": stale.value, "engine": engine.value, "runtime": runtime.value, "fleet": fleet}
        _run(recipe, None, out, seeds, as_json, "run", how)


def _forecast(path: Path, as_json: bool) -> None:
    use_threads(1)
    from flcav.interface.progress import show_progress
    from flcav.runs.forecast import forecast_run
    from flcav.runs.recipe import load_run_recipe
    from flcav.sources.recipe import find_recipe

    found = find_recipe(path)
    with show_progress(f"forecast {path}") as report:
        forecast = forecast_run(load_run_recipe(found), beside=found.parent, progress=report)
    if as_json:
        print_json(forecast.as_json())
        return
    for line in forecast.lines():
        echo(line)


@when_interrupted()
@only_writer_of("out")
def demo(
    out: Path = typer.Option(
        Path("out/demo"), "--out", help="Folder of the run; the same command goes on after a stop."
    ),
    seed: int | None = typer.Option(None, "--seed", min=0, help="Seed of traffic, sensors and training, if not 1."),
    recipe: Path = typer.Option(Path("recipes/runs/demo.yaml"), "--recipe", help="Another run recipe."),
    seeds: int = SEEDS,
    jobs: int = JOBS,
    engine: EngineName = ENGINE,
    stale: Stale = STALE,
) -> None:
    """Run recipes/runs/demo.yaml: pretraining, roadside sensors, edge FL and cloud FL on three towns."""
    _run(recipe, seed, out, seeds, False, "demo", {"jobs": jobs, "stale": stale.value, "engine": engine.value})


def _run(
    path: Path,
    seed: int | None,
    out: Path,
    seeds: int,
    as_json: bool,
    title: str,
    how: Mapping[str, Any],
) -> None:
    """Run a recipe; `how`: arguments of `flcav.run`."""
    use_threads(1)
    from flcav.cli.steps import live_steps
    from flcav.experiments.seed_tables import draw_seeds
    from flcav.report.pages.run_page import write_report
    from flcav.runs.recipe import load_run_recipe
    from flcav.runs.running import run as run_one
    from flcav.runs.running import run_seeds
    from flcav.sources.recipe import find_recipe
    from flcav.storage.files import check_writable, write_bytes

    check_writable(out)
    found = find_recipe(path)
    asked = load_run_recipe(found)
    if seed is not None:
        asked = asked.model_copy(update={"seed": seed})
    how = {**how, "beside": found.parent}
    with live_steps(title) as notify:
        if seeds == 1:
            results = {out: run_one(asked, out, notify=notify, **how)}
            summary = None
        else:
            runs, summary = run_seeds(asked, out, seeds=seeds, notify=notify, **how)
            results = {out / f"seed{each.recipe.seed}": each for each in runs}
            write_bytes(out / "seeds.png", draw_seeds(runs))
    reports = [write_report(result, folder) for folder, result in results.items()]
    if as_json:
        first = next(iter(results.values()))
        print_json((summary or first).as_json())
        return
    _tell(list(results.values()), summary)
    for report, result in zip(reports, results.values(), strict=True):
        took = f", in {result.elapsed_s / 60:.1f} minutes" if result.elapsed_s else ""
        echo(f"{report}: the report{took}")


def _tell(results: "list[Run]", summary: "Summary | None") -> None:
    from flcav.runs.analysis.caveats import PLACED_BARE
    from flcav.runs.analysis.costs import tell_gain
    from flcav.runs.results.training import TOGETHER

    if summary is None:
        for sentence in tell_gain(results[0]):
            echo(sentence)
        for finding in results[0].findings:
            echo(f"{finding.question}: {finding.decision}. {finding.sentence}")
        for name, arm in results[0].arms.items():
            if arm.privacy is not None:
                echo(f"{name}, {TOGETHER}: {arm.privacy.describe()}")
        for row in results[0].describe_rows():
            echo(row)
        if PLACED_BARE in results[0].caveats:
            echo(f"privacy: {PLACED_BARE}")
        return
    for row in (*summary.measures, *summary.differences):
        kind = f" ({row.kind} claim)" if row.kind else ""
        judged = f": {row.judged.verdict}{kind}, {row.judged.describe()}" if row.judged else ""
        echo(f"{row.name}: {row.estimate.describe()} over {plural(len(summary.seeds), 'seed')}{judged}")
    for claim in summary.claims:
        echo(claim.describe())


def compare(
    first: Path = typer.Argument(help="Folder of a run, of one seed or several; with --data, a file of weights."),
    second: Path = typer.Argument(help="Folder of another, with the same test frames; or a file of weights."),
    data: Path | None = typer.Option(None, "--data", help="Dataset that two networks are compared on."),
    task: str | None = typer.Option(None, "--task", help="Task of the networks, if not that of the first one's card."),
    agents: str | None = AGENTS,
    as_json: bool = AS_JSON,
) -> None:
    """Compare two runs, or two networks on a dataset: differences, second minus first, on the same frames."""
    if data is not None:
        _compare_networks(first, second, data, task, agents, as_json)
        return
    for option, value in (("--task", task), ("--agents", agents)):
        if value is not None:
            raise InputError(f"{option}: only two networks have one, and without --data two runs are compared")
    from flcav.runs.comparing import compare as compare_runs

    rows = compare_runs(first, second)
    if as_json:
        print_json({"compared": [dataclasses.asdict(row) for row in rows]})
        return
    for row in rows:
        change = row.difference
        interval = "no interval: one scene" if change.low is None else f"{change.low:+.3f} to {change.high:+.3f}"
        arm = "" if row.arm == "main" else f" ({row.arm})"
        echo(
            f"{row.region}, {row.task}, {row.stage}{arm}: {row.measure} {row.first:.3f} -> {row.second:.3f}, "
            f"{change.mean:+.3f} ({interval}): {row.verdict}{f', p {row.judged.p_cell}' if row.judged else ''}"
        )


def _compare_networks(
    first: Path, second: Path, data: Path, task: str | None, agents: str | None, as_json: bool
) -> None:
    from flcav.interface.progress import show_progress
    from flcav.perception.networks import compare_networks
    from flcav.perception.weights import read_card

    if odd := next((path for path in (first, second) if path.is_dir()), None):
        raise InputError(f"{odd}: a folder; with --data two files of weights are compared")
    with show_progress(f"compare on {data}") as report:
        asked = task or read_card(first).task
        found = compare_networks(asked, data, first, second, agents=agents, progress=report)
    if as_json:
        print_json(found.as_json())
        return
    for line in found.lines():
        echo(line)
