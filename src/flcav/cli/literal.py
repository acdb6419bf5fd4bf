"""Help that is shown as it was written: typer reads it as Rich's markup, in which `[m]` is a style and not a unit."""

import inspect

import click
from rich.markup import escape


def literal(command: click.Command) -> click.Command:
    """Return the command with its help, its parameters' and its subcommands' safe from being read as markup.

    Lines that a docstring breaks are joined: they are broken again as wide as the terminal is.
    """
    for owner in (command, *command.params):
        text = inspect.cleandoc(getattr(owner, "help", None) or "")
        owner.help = "\n\n".join(escape(" ".join(paragraph.split())) for paragraph in text.split("\n\n"))  # type: ignore
    for subcommand in getattr(command, "commands", {}).values():
        literal(subcommand)
    return command
