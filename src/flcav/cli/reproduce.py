"""`flcav reproduce`: the figures and comparisons of the article, from commands anyone can run again."""

from enum import StrEnum
from pathlib import Path

import typer


class Target(StrEnum):
    """What can be reproduced."""

    demo_arms = "demo-arms"


class Scale(StrEnum):
    """How large."""

    quick = "quick"
    paper = "paper"


def reproduce(
    target: Target = typer.Argument(..., help="What to reproduce."),
    out: Path = typer.Option(..., "--out", help="Folder of the runs; the same command goes on after a stop."),
    seeds: int = typer.Option(5, "--seeds", min=1, help="Number of seeds, from 1."),
    scale: Scale = typer.Option(Scale.paper, "--scale", help="paper: as committed; quick: the demo's size."),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each."),
) -> None:
    """Run every arm of the demo's comparison over seeds; write result.json and arms.png."""
    from flcav.cli.steps import live_steps
    from flcav.experiments.demo_arms import arms_protocol, draw_arms, run_arms
    from flcav.files import write_bytes, write_json

    protocols = [arms_protocol(seed, scale.value) for seed in range(1, seeds + 1)]
    with live_steps(target.value) as notify:
        results = run_arms(protocols, out, jobs=jobs, notify=notify)
    write_json(out / "result.json", results)
    write_bytes(out / "arms.png", draw_arms(results))
    for arm, closed in results["summary"]["gap_closed"].items():
        typer.echo(f"{arm}: closes {closed['mean']:.2f} of the gap ({closed['low']:.2f} to {closed['high']:.2f})")
    typer.echo(f"{out / 'result.json'}: the numbers of {seeds} seeds")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command()(reproduce)
