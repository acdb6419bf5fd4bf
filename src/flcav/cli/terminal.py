"""Terminal output: a plain console, JSON, and messages for Ctrl-C."""

import contextlib
import functools
import inspect
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import typer

from flcav.config import Json
from flcav.interface.wording import escape_invisible, make_printable
from flcav.machine.locks import only_writer

if TYPE_CHECKING:
    from rich.console import Console

Answer = Iterator[Any]  # a JSON value, followed by lines: strings, or tables and texts of Rich
LONGEST = 1000  # greatest length of a message
AS_JSON = typer.Option(False, "--json", help="Print one JSON object.")
GOES_ON = "the same command goes on where it stopped"


def one_line(message: str) -> str:
    """Return a message as one printable line, cut to `LONGEST`."""
    return make_printable(" ".join(message.split()), LONGEST)


def echo(message: object = "", nl: bool = True, err: bool = False) -> None:
    """Print a message on stdout or stderr with its invisible characters escaped.

    Text from files and other machines must not control the terminal, such as by escape sequences.
    """
    click.echo(escape_invisible(str(message), "\n\t"), nl=nl, err=err)


def plain_console() -> "Console":
    """Return a console on stdout without markup and emoji, since users' names may have brackets and colons."""
    from rich.console import Console

    return Console(highlight=False, markup=False, emoji=False)


def print_json(value: Json) -> None:
    """Print one JSON object on stdout, with null for inf and nan, which JSON does not have."""
    echo(json.dumps(_finite(value), allow_nan=False))


def answer_json(command: Callable[..., Answer]) -> Callable[..., None]:
    """Decorate a command that yields its answer as a JSON value, followed by the lines of the answer in words.

    The command gets the option `--json`, which prints the value in place of the lines.
    """

    @functools.wraps(command)
    def answer(*, as_json: bool, **options: Any) -> None:
        answers = command(**options)
        value = next(answers)
        if as_json:
            print_json(value)
        for line in answers:
            if not as_json:
                echo(line) if isinstance(line, str) else plain_console().print(line)

    given = inspect.signature(command)
    option = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=AS_JSON, annotation=bool)
    answer.__signature__ = given.replace(  # pyright: ignore[reportAttributeAccessIssue]
        parameters=[*given.parameters.values(), option], return_annotation=None
    )
    answer.__annotations__ = {**command.__annotations__, "as_json": bool, "return": None}
    return answer


def wants_json() -> bool:
    """Return whether the running command was given `--json`."""
    return bool(click.get_current_context().params.get("as_json"))


def _finite(value: Json) -> Json:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Interrupted(Exception):
    """Raised for Ctrl-C, with a message about the work that is kept."""


@contextlib.contextmanager
def when_interrupted(kept: Callable[[], str] = lambda: GOES_ON) -> Iterator[None]:
    """Convert Ctrl-C within the context into `Interrupted` with the message of `kept`; Typer only sets an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(kept()) from None


def only_writer_of(option: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator of commands that holds the lock of the path given by `option`, if any, while they run."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def locked(**options: Any) -> None:
            path: Path | None = options[option]
            with contextlib.nullcontext() if path is None else only_writer(path):
                command(**options)

        return locked

    return decorate
