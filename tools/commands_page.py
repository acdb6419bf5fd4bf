"""Write docs/commands.md, a list of the commands, and a page of each group of them: python tools/commands_page.py.

A group's page, in docs/commands/, has its commands with their options and an example that is run.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import click
import typer
import yaml
from PIL import Image
from pydantic import BaseModel, ConfigDict

import flcav
from flcav.cli.main import app
from flcav.cli.options import SHOWN
from flcav.storage.markdown import format_table

ROOT = Path(__file__).parents[1]
INDEX = ROOT / "docs" / "commands.md"
GROUPS = INDEX.with_suffix("")  # the folder of the groups' pages
WIDEST = 1000  # pixels of a picture
HEAD, TAIL = 7, 2  # lines of a longer output that are shown
INTRO = """\
# Commands

The commands of `flcav` by group. The page of a group shows the arguments and options of its commands, and an example
with its output. `flcav COMMAND --help` prints the same descriptions. The exit code is 0 for success, 2 for bad input
(with one sentence about it on stderr), 130 after Ctrl-C, and 1 for any other failure. `--json` prints one JSON object
and nothing else. On a terminal, long work shows the time left, and a command ends with the one that usually follows.
Terms are in the [glossary](glossary.md).
"""
MADE = """\
These pages are made by `python tools/commands_page.py`, which runs the examples of `src/flcav/cli/commands.yaml` in the
order of the pages in one folder, with a copy of the repository's `recipes/` in it: an example may read files of an
earlier one. In their output, which is shortened, `...` stands for the folder that flcav is installed in.
"""


class Example(BaseModel):
    """Lines of a shell for a command: those that are run, or those that are only shown."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    run: tuple[str, ...] = ()
    shown: tuple[str, ...] = ()
    picture: str = ""  # a file that it writes, shown below
    next: str = ""  # the command that follows, which a terminal shows


class Section(BaseModel):
    """Commands that belong together."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: str
    said: str  # with links as from the group's page
    files: Mapping[str, str] = {}
    commands: Mapping[str, Example]

    @property
    def slug(self) -> str:
        """Return the name of the group's page without its suffix."""
        return self.title.lower().replace(" ", "-")


def sections() -> tuple[Section, ...]:
    """Return what the page shows, in order."""
    return tuple(map(Section.model_validate, yaml.safe_load(SHOWN.read_text(encoding="utf-8"))))


def commands_of(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Yield each command that does something, by the words that call it."""
    inner: Mapping[str, click.Command] = getattr(command, "commands", {})
    if not inner:
        yield " ".join(words), command
    for name, each in inner.items():
        yield from commands_of(each, (*words, name))


def pages(printed: Mapping[str, str]) -> dict[Path, str]:
    """Return the text of every page by its path; `printed` has the console block of each command."""
    known = dict(commands_of(typer.main.get_command(app)))
    groups = {GROUPS / f"{section.slug}.md": group_page(section, known, printed) for section in sections()}
    return {INDEX: index_page(known), **groups}


def index_page(known: Mapping[str, click.Command]) -> str:
    """Return the list of all commands by group, each with the beginning of its help."""
    parts = [INTRO]
    for section in sections():
        rows = (
            (f"[flcav {name}]({GROUPS.name}/{section.slug}.md#flcav-{name.replace(' ', '-')})", summary(known[name]))
            for name in section.commands
        )
        parts.append(f"## {section.title}\n\n{format_table(('command', 'description'), rows)}\n")
    listed = "\n".join(f"{section.title} <{GROUPS.name}/{section.slug}>" for section in sections())
    return "\n".join((*parts, MADE, f"```{{toctree}}\n:hidden:\n{listed}\n```\n"))


def summary(command: click.Command) -> str:
    """Return what a command's help begins with, up to the first colon, semicolon or full stop."""
    said = " ".join((command.help or "").split("\n\n")[0].split())
    return re.split(r"[:;.](?= |$)", said)[0]


def group_page(section: Section, known: Mapping[str, click.Command], printed: Mapping[str, str]) -> str:
    """Return the page of a group of commands."""
    parts = [f"# Commands: {section.title.lower()}\n\n{section.said}\n"]
    parts += (f"`{name}`:\n\n```yaml\n{text}```\n" for name, text in section.files.items() if name.endswith("yaml"))
    parts += (f"`{name}`:\n\n```csv\n{text}```\n" for name, text in section.files.items() if name.endswith("csv"))
    for name, example in section.commands.items():
        shown = f"![What flcav {name} draws]({picture_of(name).name})\n" if example.picture else ""
        parts += filter(None, (described(name, known[name], printed[name]), shown))
    return "\n".join(parts)


def described(name: str, command: click.Command, printed: str) -> str:
    """Return the part of a page about a command."""
    said = "\n\n".join(" ".join(each.split()) for each in (command.help or "").split("\n\n"))
    options = format_table(("option", "description"), map(row, command.params))
    return f"## flcav {name}\n\n{said}\n\n{options}\n\n{printed}\n"


def picture_of(name: str) -> Path:
    """Return the path of the picture of a command's example, beside its group's page."""
    return GROUPS / f"{name.replace(' ', '-')}.png"


def row(parameter: click.Parameter) -> tuple[str, str]:
    """Return an option's or an argument's name, and its help with the default."""
    argument = isinstance(parameter, click.Argument)
    name = parameter.make_metavar(click.Context(click.Command(""))) if argument else ", ".join(parameter.opts)
    value = parameter.default
    none = value is None or value is False or value == []
    default = " Required." if parameter.required else "" if none else f" Default: `{value}`."
    said = " ".join(getattr(parameter, "help", None or "").split())
    choices = parameter.type.choices if isinstance(parameter.type, click.Choice) and not argument else ()
    if any(not re.search(rf"\b{re.escape(each)}\b", said) for each in choices):
        said = f"{said} One of {', '.join(f'`{each}`' for each in choices)}."
    return f"`{name}`", said.replace("|", "\\|").replace("[", "\\[") + default


def examples_in(text: str) -> dict[str, str]:
    """Return the example of each command on a group's page."""
    return dict(re.findall(r"^## flcav (.*?)\n.*?^(```console\n.*?^```)$", text, re.M | re.S))


def read_examples() -> dict[str, str]:
    """Return the example of each command from the pages as they are."""
    return examples_in("\n".join(path.read_text(encoding="utf-8") for path in sorted(GROUPS.glob("*.md"))))


def run_examples(folder: Path) -> dict[str, str]:
    """Run every example in a folder and return what was typed and printed; raises RuntimeError where one fails."""
    shutil.copytree(ROOT / "recipes", folder / "recipes")
    printed: dict[str, str] = {}
    for section in sections():
        for name, text in section.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        for name, example in section.commands.items():
            blocks = [f"$ {line}\n{output_of(line, folder)}" for line in example.run]
            blocks += [f"$ {line}\n" for line in example.shown]
            printed[name] = "```console\n" + "".join(blocks) + "```"
            if example.picture:
                copy_picture(folder / example.picture, picture_of(name))
    return printed


def copy_picture(path: Path, to: Path) -> None:
    """Write a picture as PNG of 64 colours, at most `WIDEST` pixels wide."""
    with Image.open(path) as picture:
        picture.thumbnail((WIDEST, WIDEST))
        to.parent.mkdir(exist_ok=True)
        picture.convert("RGB").quantize(64, kmeans=3).save(to, optimize=True)


def output_of(line: str, folder: Path) -> str:
    """Return what a line of a shell prints."""
    print(f"$ {line}", flush=True)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    settings = os.environ | {"PATH": path, "COLUMNS": "90", "NO_COLOR": "1", "TERM": "dumb"}
    settings["MPLCONFIGDIR"] = str(folder.with_name("matplotlib"))  # a list of fonts of its own: none is missing
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line],
        cwd=folder,
        env=settings,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    if done.returncode:
        raise RuntimeError(f"{line}: exit code {done.returncode}\n{done.stdout}")
    told = done.stdout.replace(str(Path(flcav.__file__).parent), "...")
    return "".join(f"{each.rstrip()}\n" for each in shorten(told.splitlines()))


def shorten(lines: list[str]) -> list[str]:
    """Return the first and last lines of a long output, and between them how many are left out; no end of a table."""
    if len(lines) <= HEAD + TAIL + 1:
        return lines
    last = [line for line in lines[-TAIL:] if not line.startswith(("│", "└"))]
    return [*lines[:HEAD], f"[{len(lines) - HEAD - len(last)} more lines]", *last]


def main(
    keep_examples: Annotated[bool, typer.Option(help="Keep the examples' output as it stands on the pages.")] = False,
) -> None:
    """Write the pages of all commands; their examples take some ten minutes."""
    with tempfile.TemporaryDirectory() as scratch:
        printed = read_examples() if keep_examples else run_examples(Path(scratch) / "examples")
    for path, text in pages(printed).items():
        path.write_text(text, encoding="utf-8")
        print(path)


if __name__ == "__main__":
    typer.run(main)
