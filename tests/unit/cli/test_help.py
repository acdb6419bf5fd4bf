"""The help of every command, as it is shown."""

import inspect
import os
import re
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

import click
import commands_page
import pytest
import typer

from flcav.cli.main import app, run
from flcav.cli.options import Device, EngineName, Method
from flcav.dataset.formats.formats import EXPORTS, IMPORTS
from flcav.dataset.recording.recorder import ENGINES
from flcav.perception.device import select_device
from flcav.perception.tasks import TASKS, task_named

Commands = Iterator[tuple[tuple[str, ...], click.Command]]


def commands(command: click.Command, path: tuple[str, ...] = ()) -> Commands:
    """Yield every command as it was written, with the words that call it."""
    yield path, command
    for name, each in getattr(command, "commands", {}).items():
        yield from commands(each, (*path, name))


WIDE = 900  # [columns] of a terminal in which no text is wrapped
EVERY = dict(commands(typer.main.get_command(app)))
each_command = pytest.mark.parametrize("path", EVERY, ids=lambda path: " ".join(path) or "flcav")


SHOWN: dict[tuple[tuple[str, ...], int], str] = {}  # help by words of a command and columns of the terminal


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def show(path: tuple[str, ...], width: int) -> str:
        if (path, width) not in SHOWN:
            monkeypatch.setenv("COLUMNS", str(width))
            with pytest.raises(SystemExit) as ended:
                run([*path, "--help"])
            assert ended.value.code == 0
            SHOWN[path, width] = capsys.readouterr().out
        return SHOWN[path, width]

    return show


def words(text: str) -> str:
    return " ".join(text.split())


def test_commands_are_in_groups_each_with_an_example(shown):
    overview = shown((), WIDE)
    listed = [line.split()[1] for line in overview.splitlines() if re.match(r"│ \w", line)]
    assert {*listed} == {path[0] for path in EVERY if path}
    titles = [section.title for section in commands_page.sections()]
    assert [title for title in re.findall(r"^╭─ (.*?) ─", overview, re.M) if title != "Options"] == titles
    for path, command in EVERY.items():
        if not getattr(command, "commands", {}):
            assert f"Example: flcav {' '.join(path)}" in shown(path, WIDE), path


def test_a_shell_completes_commands():
    asked = {"_FLCAV_COMPLETE": "complete_bash", "COMP_WORDS": "flcav re", "COMP_CWORD": "1"}
    program = Path(sys.executable).with_name("flcav")
    done = subprocess.run([program], env=os.environ | asked, capture_output=True, text=True, check=True)
    assert {*done.stdout.split()} == {"record", "replan", "reproduce", "release"}


@each_command
def test_help_is_shown_as_it_was_written(path, shown):
    command, told = EVERY[path], words(shown(path, WIDE))
    assert "…" not in told
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        assert words(paragraph) in told
    for parameter in command.params:
        text = getattr(parameter, "help", None)
        assert text, f"{parameter.name} has no help"
        assert words(text) in told
    for subcommand in getattr(command, "commands", {}).values():
        assert words(inspect.cleandoc(subcommand.help).split("\n\n")[0]) in told


@each_command
def test_in_a_narrow_terminal_help_is_wrapped_and_only_names_of_options_are_cut(path, shown):
    told = shown(path, 80)
    for paragraph in inspect.cleandoc(EVERY[path].help or "").split("\n\n"):
        assert words(paragraph) in words(told)
    for cut in re.findall(r"\S*…", told):
        (option,) = [each for each in EVERY[path].params if any(name.startswith(cut[:-1]) for name in each.opts)]
        assert any(not name.startswith("--") and name in told for name in option.opts), cut


@each_command
def test_what_can_be_chosen_is_listed(path, shown):
    told = words(shown(path, WIDE))
    for parameter in EVERY[path].params:
        if isinstance(parameter.type, click.Choice):
            names = [str(choice) for choice in parameter.type.choices]
            in_words = f"{', '.join(names[:-1])} or {names[-1]}"
            assert in_words in told or f"[{'|'.join(names)}]" in told, parameter.name


def test_choices_are_those_that_there_are():
    assert [*EngineName] == [*ENGINES]
    for device in Device:
        if device != Device.cuda:
            select_device(device)


def test_formats_are_named(shown):
    for command, known in (("export", EXPORTS), ("import", IMPORTS)):
        *others, last = known
        assert f"{', '.join(others)} or {last}, or one of your own as module:NAME" in words(shown((command,), WIDE))


def test_tasks_and_networks_are_named(shown):
    page = (Path(__file__).parents[3] / "docs" / "tasks.md").read_text()
    for command in ("train", "evaluate", "infer", "errors"):
        assert "weather, signs, objects, trajectory or road, or one of your own" in shown((command,), 400)
    for name in TASKS:
        (row,) = re.findall(rf"^\| `{name}` \| (?:camera|LiDAR|tracks).*$", page, re.M)
        assert all(f"`{network}`" in row for network in task_named(name).configurations)


@pytest.mark.parametrize(
    ("arguments", "wrong", "choices"),
    [
        (("train", "poetry", "--data", "d", "--out", "o"), "task 'poetry'", TASKS),
        (("evaluate", "poetry", "--data", "d"), "task 'poetry'", TASKS),
        (("infer", "poetry", "d"), "task 'poetry'", TASKS),
        (("errors", "poetry", "--data", "d", "--out", "o.csv"), "task 'poetry'", TASKS),
        (("export", "poetry", "d", "--out", "o"), "export format 'poetry'", EXPORTS),
        (("record", "r", "--out", "o", "--engine", "steam"), "'--engine'", EngineName),
        (("infer", "weather", "d", "--device", "steam"), "'--device'", Device),
        (("place", "--method", "steam"), "'--method'", Method),
        (("export",), "'FORMAT'", ()),
        (("import", "poetry", "d", "--out", "o"), "import format 'poetry'", IMPORTS),
    ],
)
def test_a_wrong_choice_is_one_sentence(arguments, wrong, choices: Collection[str], capsys):
    with pytest.raises(SystemExit) as ended:
        run(list(arguments))
    told = capsys.readouterr()
    assert (ended.value.code, told.out) == (2, "")
    (line,) = told.err.splitlines()
    assert wrong in line
    assert all(choice in line for choice in choices)
