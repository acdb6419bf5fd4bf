"""`flcav reproduce`: the figures and comparisons of the article, from commands anyone can run again."""

from enum import StrEnum
from pathlib import Path

import typer


class Target(StrEnum):
    """What can be reproduced."""

    demo_arms = "demo-arms"
    fig3a = "fig3a"
    fig6a_allocation = "fig6a-allocation"


class Scale(StrEnum):
    """How large."""

    quick = "quick"
    paper = "paper"


SEEDS = {Target.demo_arms: 5, Target.fig6a_allocation: 3}


def reproduce(
    target: Target = typer.Argument(..., help="What to reproduce."),
    out: Path = typer.Option(..., "--out", help="Folder of the runs; the same command goes on after a stop."),
    seeds: int | None = typer.Option(
        None, "--seeds", min=1, help="Number of seeds, from 1: 5 of demo-arms, 3 of fig6a-allocation if not given."
    ),
    scale: Scale = typer.Option(Scale.paper, "--scale", help="paper: as committed; quick: the demo's size."),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each."),
) -> None:
    """Run what a figure of the article claims, or draw it; write result.json and a picture."""
    if target == Target.fig3a:
        _fig3a(out)
        return
    run = _fig6a_allocation if target == Target.fig6a_allocation else _demo_arms
    run(out, range(1, (seeds or SEEDS[target]) + 1), scale.value, jobs)
    typer.echo(f"{out / 'result.json'}: the numbers of {seeds or SEEDS[target]} seeds")


def _fig3a(out: Path) -> None:
    from flcav.experiments.fig3a import draw_fig3a, fig3a
    from flcav.files import write_bytes, write_json

    results = fig3a()
    write_json(out / "result.json", results)
    write_bytes(out / "fig3a.png", draw_fig3a(results))
    for sentence in results["findings"]:
        typer.echo(sentence)


def _demo_arms(out: Path, seeds: range, scale: str, jobs: int) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.demo_arms import arms_protocol, draw_arms, run_arms
    from flcav.files import write_bytes, write_json

    with live_steps(Target.demo_arms.value) as notify:
        results = run_arms([arms_protocol(seed, scale) for seed in seeds], out, jobs=jobs, notify=notify)
    write_json(out / "result.json", results)
    write_bytes(out / "arms.png", draw_arms(results))
    for arm, closed in results["summary"]["gap_closed"].items():
        typer.echo(f"{arm}: closes {closed['mean']:.2f} of the gap ({closed['low']:.2f} to {closed['high']:.2f})")


def _fig6a_allocation(out: Path, seeds: range, scale: str, jobs: int) -> None:
    from flcav.cli.steps import live_steps
    from flcav.experiments.fig6a_allocation import allocation_protocol, draw_allocation, run_allocation
    from flcav.files import write_bytes, write_json

    with live_steps(Target.fig6a_allocation.value) as notify:
        results = run_allocation([allocation_protocol(seed, scale) for seed in seeds], out, jobs=jobs, notify=notify)
    write_json(out / "result.json", results)
    write_bytes(out / "plans.png", draw_allocation(results))
    for finding in results["findings"]:
        typer.echo(f"{finding['question']} {finding['verdict']}. {finding['sentence']}")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command()(reproduce)
