"""Pages of commands: every command is there, its options are those of today, and each example was run as it stands."""

import re
import shlex

import commands_page
import pytest
import typer

from flcav.cli.main import app

PAGES = {path: path.read_text(encoding="utf-8") for path in (commands_page.INDEX, *commands_page.GROUPS.glob("*.md"))}
EXAMPLES = commands_page.read_examples()
SECTIONS = commands_page.sections()
SHOWN = {name: example for section in SECTIONS for name, example in section.commands.items()}


def test_every_command_is_on_a_page():
    commands = {name for name, _ in commands_page.commands_of(typer.main.get_command(app))}
    assert {*EXAMPLES} == {*SHOWN} == commands


def test_the_pages_say_what_the_commands_say_of_themselves():
    assert commands_page.pages(EXAMPLES) == PAGES, "run: python tools/commands_page.py"


@pytest.mark.parametrize("name", SHOWN)
def test_an_example_is_of_its_command_and_was_run(name: str):
    lines = (*SHOWN[name].run, *SHOWN[name].shown)
    assert tuple(re.findall(r"^\$ (.*)$", EXAMPLES[name], re.M)) == lines
    assert any(shlex.split(line)[: 1 + len(name.split())] == ["flcav", *name.split()] for line in lines)
    assert SHOWN[name].shown or len(EXAMPLES[name].splitlines()) > 2 + len(lines)
    assert not SHOWN[name].picture or commands_page.picture_of(name).is_file()


def test_no_page_names_a_folder_of_the_machine_that_it_was_made_on():
    assert not any(re.search(r"/(home|root|tmp|work|Users)/", text) for text in PAGES.values())
