"""Options that several commands share."""

import typer

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
