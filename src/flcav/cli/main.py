"""The `flcav` command. Exit codes: 0 done; 2 bad input, one sentence on stderr; 130 interrupted; 1 anything else."""

import atexit
import errno
import functools
import gc
import re
import signal
import sys

import click
import typer

from flcav import __version__
from flcav.cli import run as run_command
from flcav.cli.carla import carla
from flcav.cli.data import export, import_, record, validate
from flcav.cli.domains.importance import importance
from flcav.cli.domains.odd import odd
from flcav.cli.domains.sampling import sample
from flcav.cli.drive import drive
from flcav.cli.federate import federate
from flcav.cli.fleet import fleet
from flcav.cli.network import radio, rounds
from flcav.cli.options import add_examples, add_next_steps, escape_markup
from flcav.cli.perception import errors, evaluate, infer, train
from flcav.cli.pictures import birdseye, camera, view
from flcav.cli.planning.allocate import allocate, replan
from flcav.cli.planning.fit import fit
from flcav.cli.planning.history import history
from flcav.cli.planning.place import place
from flcav.cli.planning.planner import planner
from flcav.cli.releases.release import release
from flcav.cli.reproduce import reproduce
from flcav.cli.terminal import Interrupted, echo, one_line
from flcav.cli.towns import towns
from flcav.config import InputError
from flcav.interface.wording import describe_number, suggest

INTERRUPTED = 130
NO_FOLDER = (errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG)  # bad paths: through a file or a link to itself, too long

atexit.register(gc.freeze)  # searching all modules for garbage would take a second before the process ends

app = typer.Typer(
    name="flcav",
    help="Design and verify federated learning for connected autonomous vehicle perception.\n\n"
    "Exit codes: 0 done, 2 bad input (one sentence on stderr), 130 interrupted (Ctrl-C), 1 anything else.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _version(value: bool) -> None:
    if value:
        echo(f"flcav {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


for command in (
    *(run_command.run, run_command.demo, run_command.compare, federate),
    *(record, validate, birdseye, camera, view, export, import_),
    *(train, evaluate, infer, errors),
    *(allocate, replan, place, planner, fit, history),
    *(radio, rounds, drive, reproduce),
):
    app.command(command.__name__.rstrip("_"))(command)
odd.command("sample")(sample)
odd.command("importance")(importance)
for name, group in {"towns": towns, "odd": odd, "carla": carla, "fleet": fleet, "release": release}.items():
    app.add_typer(group, name=name)


@functools.cache
def _build_command(*, terminal: bool) -> click.Command:
    """Return the command line as Click has it, which takes 50 ms to build; on a terminal it tells what follows."""
    command = escape_markup(typer.main.get_command(app))
    if terminal and isinstance(command, click.Group):
        add_next_steps(command)
    return command


def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; exceptions become exit codes here only."""
    if (
        arguments is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):  # not within another program
        signal.signal(signal.SIGINT, _interrupt)
    try:
        command = _build_command(terminal=sys.stderr.isatty())
        typed = sys.argv[1:] if arguments is None else arguments
        if isinstance(command, click.Group) and (not typed or "--help" in typed):
            add_examples(command)
        code = command(args=arguments, standalone_mode=False)
        if code == INTERRUPTED:  # typer's exit code for Ctrl-C
            raise KeyboardInterrupt
    except Interrupted as kept:
        _say(f"interrupted; {kept}")
        code = INTERRUPTED
    except (click.exceptions.Abort, KeyboardInterrupt):
        _say("interrupted")
        code = INTERRUPTED
    except click.ClickException as error:
        _say(_describe(error))
        code = 2
    except InputError as error:
        _say(str(error))
        code = 2
    except OSError as error:
        _say(f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error))
        wrong = isinstance(error, FileNotFoundError | IsADirectoryError) or error.errno in NO_FOLDER
        code = 2 if wrong else 1
    sys.exit(code if isinstance(code, int) else 0)


def _interrupt(*_: object) -> None:
    """Raise KeyboardInterrupt for the first Ctrl-C; later ones are ignored while the command ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def _describe(error: click.ClickException) -> str:
    """Return the message for a wrong call, with a suggestion for a misspelt name or a number with a unit."""
    if "Did you mean" in error.message:  # Typer has added what Click adds when it formats the message
        return error.message
    given = re.match(r"'(.*)' is not ", error.message)
    if not isinstance(error, click.BadParameter) or error.param is None or given is None:
        return error.format_message()
    kind = error.param.type
    message = error.format_message()
    if isinstance(kind, click.Choice):
        return message.removesuffix(".") + suggest(given[1], map(str, kind.choices))
    if isinstance(kind, click.types.FloatParamType):
        advice = describe_number(given[1], error.param.name or "")
        return re.sub(r"is not a valid float( range)?\.", lambda _: advice, message)
    return message


def _say(message: str) -> None:
    """Print a message as one line on stderr, unless it is empty, as after the help."""
    if line := one_line(message):
        print(f"flcav: {line}", file=sys.stderr)
