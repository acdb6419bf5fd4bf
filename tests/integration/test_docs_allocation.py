"""The commands of docs/allocation.md, run as they stand there: they print what the page says, and its words are those
of the plan's page."""

import re
import shlex
from pathlib import Path

import pytest

from flcav.cli.main import run
from flcav.optimization.allocation.problem_file import CURVE, STEPS, TERMS

PAGE = (Path(__file__).parents[2] / "docs" / "allocation.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]\d+)?")
FILES = dict(re.findall(r"^```\w+ (\S+)\n(.*?)^```$", PAGE, re.M | re.S))
COMMANDS = [
    (shlex.split(line), told)
    for block in re.findall(r"^```console\n(.*?)^```$", PAGE, re.M | re.S)
    for line, told in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block, re.M)
]


@pytest.mark.slow
def test_every_command_prints_what_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    for name, body in FILES.items():
        Path(name).write_text(body, encoding="utf-8")
    assert [command[:2] for command, _ in COMMANDS] == [
        ["flcav", "fit"], ["flcav", "allocate"], ["flcav", "fit"], ["flcav", "fit"],
    ]  # fmt: skip
    for command, told in COMMANDS:
        assert_same(printed(command, capsys), told, " ".join(command))


def printed(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stopped:
        run(command[1:])
    out, err = capsys.readouterr()
    assert stopped.value.code == 0, err
    return out


def assert_same(ours: str, told: str, command: str) -> None:
    """Check that the words are equal, and the numbers to a thousandth."""
    words = [" ".join(NUMBER.sub("#", text).split()) for text in (ours, told)]
    assert words[0] == words[1], command
    numbers = [[float(each) for each in NUMBER.findall(text)] for text in (ours, told)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-3), command


def test_both_layouts_hold_the_same_points() -> None:
    by_stage = [row.split(",") for row in FILES["by_stage.csv"].splitlines() if row.startswith("objects")]
    by_run = [row.split(",") for row in FILES["objects.csv"].splitlines()[1:]]
    assert [1 - float(row[3]) for row in by_stage] == pytest.approx([float(row[3]) for row in by_run])


def test_words_are_those_of_the_plans_page() -> None:
    text = " ".join(PAGE.split())
    for sentence in (*STEPS.values(), CURVE):
        assert sentence in text
    for term, sentence in TERMS.items():
        assert f"- **{term.capitalize()}**: {sentence}" in text
