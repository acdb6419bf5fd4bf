"""Options that several commands share."""

import typer

from flcav.cli.choices import Engine, Stale

THREADS = typer.Option(
    1,
    "--threads",
    min=1,
    help="Threads to compute on; part of what a seed names: another number, other weights.",
)
AGENTS = typer.Option(
    None,
    "--agents",
    help="Whose frames of a dataset: vehicles, poles, all, or names with commas between them. By default those whose "
    "sensors stand as the network expects: docs/tasks.md.",
)
JOBS = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each.")
ENGINE = typer.Option(Engine.processes, "--engine", help="Who works: processes here, or a cluster by Ray.")
STALE = typer.Option(
    Stale.refuse,
    "--stale",
    help="What becomes of steps in the folder that other code did, or that are built on such: refuse the folder, redo "
    "them, or keep them.",
)
