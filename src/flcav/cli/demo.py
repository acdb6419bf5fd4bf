"""`flcav demo`: the whole story in minutes."""

from pathlib import Path

import typer

from flcav.cli.interruption import when_interrupted
from flcav.threads import use_threads


@when_interrupted()
def demo(
    out: Path = typer.Option(
        Path("out/demo"), "--out", help="Folder of the run; the same command goes on after a stop."
    ),
    seed: int = typer.Option(1, "--seed", min=0, help="Seed of traffic, sensors and training."),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each."),
) -> None:
    """Run plan, pretraining, placement, edge FL and cloud FL on three towns; write report.html and results.json."""
    use_threads(1)
    from flcav.cli.steps import live_steps
    from flcav.experiments.demo import demo_protocol, run_demo
    from flcav.experiments.steps import stopwatch

    with live_steps("demo") as notify:
        results = run_demo(demo_protocol(seed), out, jobs=jobs, notify=notify, clock=stopwatch(out / "work"))
    for finding in results["findings"]:
        typer.echo(f"{finding['question']}: {finding['verdict']}. {finding['sentence']}")
    typer.echo(f"{out / 'report.html'}: the report, in {results['elapsed_s'] / 60:.1f} minutes")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command()(demo)
