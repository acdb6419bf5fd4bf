"""Options shared by several commands, their choices and checks, and the layout of the help."""

import functools
import inspect
import math
import shlex
import string
from collections.abc import Callable, Iterable, Iterator
from enum import StrEnum
from pathlib import Path

import click
import typer
import yaml
from click.core import ParameterSource
from rich.markup import escape

from flcav.cli.terminal import echo
from flcav.config import InputError
from flcav.perception.tasks import TASKS

THREADS = typer.Option(
    1,
    "--threads",
    min=1,
    help="Threads to compute on; another number gives other weights.",
)
AGENTS = typer.Option(
    None,
    "--agents",
    help="Whose frames: vehicles, poles, all, or names with commas between them; by default those whose sensors stand "
    "as the network expects (docs/tasks.md).",
)
AROUND = typer.Option(
    False,
    "--around",
    help="objects: detect in 360 degrees, in four passes over the rotated sweep, and not ahead alone.",
)
JOBS = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each.")


class Device(StrEnum):
    """Device that networks run on."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class EngineName(StrEnum):
    """Execution engine, see `flcav.dataset.recording.recorder` and `flcav.runs.engine`."""

    processes = "processes"
    ray = "ray"


class Runtime(StrEnum):
    """Runtime of a federation, see `flcav.federation.links`."""

    embedded = "embedded"
    ray = "ray"
    flower = "flower"


class Stale(StrEnum):
    """Treatment of steps that were computed by other code, see `flcav.runs.engine`."""

    refuse = "refuse"
    redo = "redo"
    keep = "keep"


class Method(StrEnum):
    """Method of placement, see `flcav.optimization.placement.solve`."""

    exact = "exact"
    greedy = "greedy"


def join_choices(choices: Iterable[str]) -> str:
    """Return the choices in words: "a, b or c"."""
    *others, last = choices
    return f"{', '.join(others)} or {last}"


OWN = "or one of your own as module:NAME"
ANY_TASK = f"{join_choices(TASKS)}, {OWN}"
FLEET = typer.Option(
    None,
    "--fleet",
    help="flower: folder of a fleet that is up, or of one for each region, FOLDER/REGION; by default one is brought up "
    "here, for as long.",
)
ENGINE = typer.Option(EngineName.processes, "--engine", help="Backend: processes on this machine, or a Ray cluster.")
STALE = typer.Option(
    Stale.refuse,
    "--stale",
    help="Steps that were done by other code or settings, and those built on them: refuse the folder, redo these "
    "steps, or keep those of other code.",
)


def check_finite(parameter: click.Parameter, value: float | None) -> float | None:
    """Return the value of a number's option (a callback); raises `InputError` for nan, which would pass any limit."""
    if value is not None and not math.isfinite(value):
        raise InputError(f"{parameter.opts[0]} {value}: a finite number is wanted")
    return value


LIDAR_HEIGHT = typer.Option(
    None,
    "--lidar-height",
    callback=check_finite,
    help="Point clouds of KITTI's layout, or files: metres of their LiDAR above the ground; by default as they show.",
)
BEAMS = typer.Option(None, "--beams", help="Likewise: beams of their LiDAR.")


def check_all_finite(parameter: click.Parameter, values: list[float]) -> list[float]:
    """Return the values of a repeatable number's option (a callback), checked as by `check_finite`."""
    for value in values:
        check_finite(parameter, value)
    return values


def check_png(parameter: click.Parameter, value: Path | None) -> Path | None:
    """Return the path of a picture's option (a callback); raises `InputError` for other endings than .png."""
    if value is not None and value.suffix.lower() not in ("", ".png"):
        raise InputError(f"{parameter.opts[0]} {value}: a PNG picture is written; name it {value.with_suffix('.png')}")
    return value


def parse_axes(by: str) -> tuple[str, str]:
    """Return the two attributes in `--by X,Y`; raises `InputError` for any other text."""
    axes = tuple(name.strip() for name in by.split(","))
    if len(axes) != 2 or axes[0] == axes[1]:
        raise InputError(f"--by {by}: two attributes are wanted, with a comma between them, as in junction,light")
    return axes


def refuse_unused(what: str, *names: str) -> None:
    """Raise `InputError` if an option among the parameters `names` was given, since it has no effect on `what`."""
    context = click.get_current_context()
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is ParameterSource.COMMANDLINE:
            raise InputError(f"{what}: has no use for {parameter.opts[0]}")


def escape_markup(command: click.Command) -> click.Command:
    """Escape Rich's markup in the help of a command, its parameters and its subcommands; return the command.

    Typer would read "[m]" as a style. Lines of a paragraph are joined, so that they wrap at the terminal's width.
    """
    for owner in (command, *command.params):
        text = inspect.cleandoc(getattr(owner, "help", None) or "")
        owner.help = "\n\n".join(escape(" ".join(paragraph.split())) for paragraph in text.split("\n\n"))  # type: ignore
    for subcommand in getattr(command, "commands", {}).values():
        escape_markup(subcommand)
    return command


WITHOUT_NEXT = ("as_json", "dry", "listed")  # options after which nothing follows
SHOWN = Path(__file__).with_name("commands.yaml")  # groups of commands, with examples


def add_examples(app: click.Group) -> None:
    """Arrange the commands of `app` in the groups of `SHOWN`, and add their examples below the options."""
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


def add_next_steps(app: click.Group) -> None:
    """Let each command of `app` print on stderr, once it is done, the command that usually follows, by `SHOWN`.

    Words in capitals are the user's to replace. Nothing is printed after the options `WITHOUT_NEXT`.
    """
    named = dict(_walk(app))
    for section in yaml.safe_load(SHOWN.read_text(encoding="utf-8")):
        for name, example in section["commands"].items():
            if "next" in example and (command := named.get(name)) and command.callback:
                command.callback = _tell_after(command.callback, example["next"])


def _tell_after(command: Callable[..., object], template: str) -> Callable[..., object]:
    """Return a command that then prints a template with its parameters; not one that needs a parameter left out."""

    @functools.wraps(command)
    def followed(**given: object) -> object:
        answer = command(**given)
        first = {name: value[0] if isinstance(value, list) and value else value for name, value in given.items()}
        told = {name: shlex.quote(str(value)) for name, value in first.items() if value not in (None, [])}
        needed = {name for _, name, _, _ in string.Formatter().parse(template) if name}
        if needed <= told.keys() and not any(given.get(name) for name in WITHOUT_NEXT):
            echo(f"next: {template.format_map(told)}", err=True)
        return answer

    return followed


def _walk(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Yield a command and its subcommands with the words that call them."""
    yield " ".join(words), command
    for name, subcommand in getattr(command, "commands", {}).items():
        yield from _walk(subcommand, (*words, name))
