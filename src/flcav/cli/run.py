"""`flcav run`, `flcav demo`, `flcav compare`: run a recipe through the three stages, and compare two runs."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import AGENTS, ENGINE, FLEET, JOBS, STALE, EngineName, Runtime, Stale, refuse_unused
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of, when_interrupted
from flcav.config import InputError
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.runs.results.run import Run, Summary
    from flcav.runs.running import RunOptions


RUNTIME = typer.Option(
    Runtime.embedded, "--runtime", help="Where vehicles train: embedded: processes here; flower: a deployed fleet."
)
SEEDS = typer.Option(1, "--seeds", min=1, help="Number of seeds, from the recipe's on; above 1, a folder each.")
DRY = typer.Option(False, "--dry", help="Say what the run would take, and do nothing of it.")


@when_interrupted()
@only_writer_of("out")
@answer_json
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
) -> Answer:
    """Run a recipe through the three stages; write report.html, results.json and history.csv."""
    if runtime is not Runtime.flower:
        refuse_unused(f"--runtime {runtime.value}", "fleet")
    if dry:
        return _forecast(recipe)
    if out is None:
        raise InputError("--out is missing: the folder of the run; --dry says what it would take")
    options: RunOptions = {"jobs": jobs, "stale": stale.value, "engine": engine.value}
    options |= {"runtime": runtime.value, "fleet": fleet}
    return _run(recipe, {}, out, seeds, "run", options)


def _forecast(path: Path) -> Answer:
    use_threads(1)
    from flcav.interface.progress import show_progress
    from flcav.runs.forecast import forecast_run
    from flcav.runs.recipe import load_run_recipe
    from flcav.sources.recipe import find_recipe

    found = find_recipe(path)
    with show_progress(f"forecast {path}") as report:
        forecast = forecast_run(load_run_recipe(found), beside=found.parent, progress=report)
    yield forecast.as_json()
    yield from forecast.lines()


@when_interrupted()
@only_writer_of("out")
def demo(
    out: Path = typer.Option(
        Path("out/demo"), "--out", help="Folder of the run; the same command goes on after a stop."
    ),
    seed: int | None = typer.Option(None, "--seed", min=0, help="Seed of traffic, sensors and training, if not 1."),
    recipe: Path = typer.Option(Path("recipes/runs/demo.yaml"), "--recipe", help="Another run recipe."),
    seeds: int = SEEDS,
    retrainings: int | None = typer.Option(
        None, "--retrainings", min=0, help="Further trainings of each seed on the same frames, if not the recipe's."
    ),
    jobs: int = JOBS,
    engine: EngineName = ENGINE,
    stale: Stale = STALE,
) -> None:
    """Run recipes/runs/demo.yaml: pretraining, roadside sensors, edge FL and cloud FL on three towns."""
    options: RunOptions = {"jobs": jobs, "stale": stale.value, "engine": engine.value}
    answer = _run(recipe, {"seed": seed, "retrainings": retrainings}, out, seeds, "demo", options)
    for line in [*answer][1:]:
        echo(line)


def _run(
    path: Path, changes: Mapping[str, int | None], out: Path, seeds: int, title: str, options: "RunOptions"
) -> Answer:
    use_threads(1)
    from flcav.cli.steps import live_steps
    from flcav.report.pages.run_page import write_report
    from flcav.report.seed_tables import draw_seeds
    from flcav.runs.recipe import load_run_recipe
    from flcav.runs.running import run as run_one
    from flcav.runs.running import run_seeds
    from flcav.sources.recipe import find_recipe
    from flcav.storage.files import check_writable, write_bytes

    check_writable(out)
    found = find_recipe(path)
    given = {name: value for name, value in changes.items() if value is not None}
    asked = load_run_recipe(found).model_copy(update=given)
    with live_steps(title) as notify:
        options = {**options, "beside": found.parent, "notify": notify}
        if seeds == 1:
            results = {out: run_one(asked, out, **options)}
            summary = None
        else:
            runs, summary = run_seeds(asked, out, seeds=seeds, **options)
            results = {out / f"seed{each.recipe.seed}": each for each in runs}
            write_bytes(out / "seeds.png", draw_seeds(runs))
    reports = [write_report(result, folder) for folder, result in results.items()]
    yield (summary or next(iter(results.values()))).as_json()
    yield from _list_lines(list(results.values()), summary)
    for report, result in zip(reports, results.values(), strict=True):
        took = f", in {result.elapsed_s / 60:.1f} minutes" if result.elapsed_s else ""
        yield f"{report}: the report{took}"


def _list_lines(results: "list[Run]", summary: "Summary | None") -> Iterator[str]:
    from flcav.runs.analysis.answer import tell_answer
    from flcav.runs.analysis.caveats import DIVERGING, PLACED_BARE
    from flcav.runs.results.training import TOGETHER

    if summary is None:
        if answer := tell_answer(results[0]):
            yield " ".join((f"{answer.word}.", *answer.sentences))
        for finding in results[0].findings:
            yield f"{finding.question}: {finding.decision}. {finding.sentence}"
        for name, arm in results[0].arms.items():
            if arm.privacy is not None:
                yield f"{name}, {TOGETHER}: {arm.privacy.describe()}"
        yield from results[0].describe_rows()
        yield from (caveat for caveat in results[0].caveats if caveat.startswith(DIVERGING))
        if PLACED_BARE in results[0].caveats:
            yield f"privacy: {PLACED_BARE}"
        return
    for row in (*summary.measures, *summary.differences):
        kind = f" ({row.kind} claim)" if row.kind else ""
        judged = f": {row.judged.verdict}{kind}, {row.judged.describe()}" if row.judged else ""
        yield f"{row.name}: {row.estimate.describe()} over {plural(len(summary.seeds), 'seed')}{judged}"
    for claim in summary.claims:
        yield claim.describe()


@answer_json
def compare(
    first: Path = typer.Argument(
        help="Folder of a run, of one seed or several; with --data, a file of weights, or packaged: the package's."
    ),
    second: Path = typer.Argument(help="Folder of another, with the same test frames; or weights, as the first."),
    data: Path | None = typer.Option(None, "--data", help="Dataset that two networks are compared on."),
    task: list[str] = typer.Option(
        [],
        "--task",
        help="Task of the networks, if not that of a card; module:NAME for one of your own; given twice, that of each.",
    ),
    agents: str | None = AGENTS,
) -> Answer:
    """Compare two runs, or two networks on a dataset: differences, second minus first, on the same frames."""
    if data is not None:
        yield from _compare_networks(first, second, data, task, agents)
        return
    for option, value in (("--task", task or None), ("--agents", agents)):
        if value is not None:
            raise InputError(f"{option}: only two networks have one, and without --data two runs are compared")
    from flcav.runs.comparing import compare as compare_runs

    rows = compare_runs(first, second)
    yield {"compared": [dataclasses.asdict(row) for row in rows]}
    for row in rows:
        change = row.difference
        interval = "no interval: one scene" if change.low is None else f"{change.low:+.3f} to {change.high:+.3f}"
        arm = "" if row.arm == "main" else f" ({row.arm})"
        yield (
            f"{row.region}, {row.task}, {row.stage}{arm}: {row.measure} {row.first:.3f} -> {row.second:.3f}, "
            f"{change.mean:+.3f} ({interval}): {row.verdict}{f', p {row.judged.p_cell}' if row.judged else ''}"
        )


def _compare_networks(first: Path, second: Path, data: Path, task: list[str], agents: str | None) -> Answer:
    from flcav.interface.progress import show_progress
    from flcav.perception.comparing import compare, read_task

    if odd := next((path for path in (first, second) if path.is_dir()), None):
        raise InputError(f"{odd}: a folder; with --data two files of weights are compared")
    if len(task) > 2:
        raise InputError(f"--task: given {len(task)} times, and two networks have at most one each")
    with show_progress(f"compare on {data}") as report:
        named = task or [read_task((first, second))]
        found = compare((named[0], named[-1]), data, first, second, agents=agents, progress=report)
    yield found.as_json()
    yield from found.lines()
