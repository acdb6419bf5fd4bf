"""`flcav odd`: operational design domains, and what driving in them asks of perception."""

import typer

from flcav.cli import importance

odd = typer.Typer(help="Operational design domains, and what driving in them asks of perception.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    importance.register(odd)
    app.add_typer(odd, name="odd")
