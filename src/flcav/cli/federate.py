"""`flcav federate`: stage II of a run recipe alone, round by round."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import FLEET, STALE, Runtime, Stale, refuse_unused
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of, wants_json, when_interrupted
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.runs.engine import Notify
    from flcav.runs.results.training import StageResult


@when_interrupted()
@only_writer_of("out")
@answer_json
def federate(
    recipe: Path = typer.Argument(help="Run recipe (YAML), of which stage II is run; see docs/runs.md."),
    out: Path = typer.Option(
        ..., "--out", help="Folder, also one of flcav run; the same command goes on after a stop."
    ),
    arm: str = typer.Option("main", "--arm", help="Arm of the recipe; by default what the recipe itself describes."),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes that vehicles train in, of one thread each."),
    runtime: Runtime = typer.Option(
        Runtime.embedded,
        "--runtime",
        help="Processes here, Flower's simulation on Ray, or a deployed Flower federation.",
    ),
    fleet: Path | None = FLEET,
    stale: Stale = STALE,
) -> Answer:
    """Run stage II of a recipe alone, edge FL in every region; print each round with its scores on validation frames.

    Speeds of vehicles, times and the network are the recipe's, as in a run. Writes federation.json, or
    federation-ARM.json for another arm, and the weights of each federation as safetensors. At the end it prints each
    task's train_s, the CPU time that a vehicle trained in a round, in the median; times.json has each vehicle's.
    """
    if runtime is not Runtime.flower:
        refuse_unused(f"--runtime {runtime.value}", "fleet")
    use_threads(1)
    from flcav.cli.steps import live_steps
    from flcav.runs.edge_stage import TRAIN_TIMES, federate_regions, measure_times, name_results
    from flcav.runs.recipe import load_run_recipe
    from flcav.runs.results.training import TOGETHER
    from flcav.sources.recipe import find_recipe
    from flcav.storage.files import check_writable

    check_writable(out)
    found = find_recipe(recipe)
    loaded = load_run_recipe(found)
    with live_steps("federate") as notify:
        watch = notify if wants_json() else _print_rounds(notify)
        how = {"beside": found.parent, "jobs": jobs, "runtime": runtime.value, "fleet": fleet, "stale": stale.value}
        results = federate_regions(loaded, out, arm=arm, notify=watch, **how)
    times = measure_times(results, out)
    yield results.as_json() | times.as_json()
    for federation in results.federations:
        yield f"{out / federation.weights}: {_describe(federation.result)}"
    for task, seconds in times.train_s.items():
        yield f"{task}: train_s {seconds:.3g}, the median CPU time of a vehicle's training in a round [s]"
    if results.privacy is not None:
        yield f"{TOGETHER}: {results.privacy.describe()}"
    yield f"{out / TRAIN_TIMES}: times and speeds of each vehicle"
    yield f"{out / name_results(arm)}: all rounds"


def _describe(result: "StageResult") -> str:
    """Return a federation in words: rounds, vehicles, samples, time on a network, and failures."""
    from flcav.federation.state import describe_empty, describe_failures

    text = f"{result.task} in {result.region}, {plural(result.rounds, 'round')}"
    text += f", {plural(result.clients, 'vehicle')}, {plural(result.samples, 'sample')}"
    records = result.records or ()
    seconds = [record.seconds for record in records if record.seconds is not None]
    text += f", {sum(seconds):.1f} s on the network" if seconds else ""
    if result.kept is not None:
        weights = f"after round {result.kept}" if result.kept else "that it began with"
        text += f", the training diverged: the weights are those {weights}"
    empty = describe_empty([record.empty for record in records])
    failures = describe_failures([record.failed for record in records])
    text = ", ".join([text, *filter(None, (empty, failures))])
    return "; ".join([text, *result.describe_rows().values()])


def _print_rounds(notify: "Notify") -> "Notify":
    """Return a `Notify` that also prints the rounds as they end."""
    from flcav.runs.edge_stage import tells_of_round

    def notify_and_print(step: str, done: int, total: int, note: str) -> None:
        of_round = tells_of_round(step, note)
        notify(step, done, total, "" if of_round else note)
        if of_round:
            echo(f"{step}, round {done} of {total}: {note}")

    return notify_and_print
