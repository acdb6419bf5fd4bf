"""Help of the command line: commands in groups, each with an example, both from `commands.yaml`."""

from collections.abc import Iterator
from pathlib import Path

import click
import yaml
from rich.markup import escape

SHOWN = Path(__file__).with_name("commands.yaml")


def add_examples(app: click.Group) -> None:
    """Put the commands of `app` into the groups of `SHOWN`, in their order, and an example below each one's options."""
    sections = yaml.safe_load(SHOWN.read_text(encoding="utf-8"))
    named = dict(_walk(app))
    listed: dict[str, click.Command] = {}
    for section in sections:
        for name, example in section["commands"].items():
            first = name.split()[0]
            if first not in listed and first in app.commands:
                listed[first] = app.commands[first]
                listed[first].rich_help_panel = section["title"]  # type: ignore[attr-defined]
            if name in named:
                lines = (*example.get("run", ()), *example.get("shown", ()))
                typed = next(line.split(" | ")[0] for line in lines if f"{line} ".startswith(f"flcav {name} "))
                named[name].epilog = f"Example: [bold]{escape(typed)}[/bold]"
    app.commands = {**listed, **app.commands}


def _walk(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Yield each command by the words that call it."""
    yield " ".join(words), command
    for name, each in getattr(command, "commands", {}).items():
        yield from _walk(each, (*words, name))
