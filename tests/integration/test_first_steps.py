"""The README's program and the commands of docs/first-hour.md, as they stand there but for fewer scenes and epochs."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from flcav.cli.main import run

ROOT = Path(__file__).parents[2]
LESS = {"scenes: 10": "scenes: 1", "spins_per_scene: 5": "spins_per_scene: 2", "cavs: 4": "cavs: 2"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working directory, with the repository's recipes, that of `suburb` smaller."""
    shutil.copytree(ROOT / "recipes", tmp_path / "recipes")
    suburb = tmp_path / "recipes" / "suburb.yaml"
    text = suburb.read_text(encoding="utf-8")
    for whole, part in LESS.items():
        assert whole in text
        text = text.replace(whole, part)
    suburb.write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_program_of_the_readme(here: Path, capsys: pytest.CaptureFixture[str]):
    (code,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    assert len([line for line in code.splitlines() if line]) <= 14
    exec(compile(code.replace("epochs=7", "epochs=1"), "README.md", "exec"), {})
    told = capsys.readouterr().out
    shown = r"AP 0\.\d\d; pole [1-4] covers \d+ of \d+ errors\n\d+ samples, \d+ edge and \d+ cloud rounds\n"
    assert re.fullmatch(shown, told)
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (printed,) = re.findall(r"^```text\n(AP .*?)^```$", page, re.M | re.S)
    assert re.fullmatch(shown, printed)
    assert told.splitlines()[1] == printed.splitlines()[1]  # the plan is of no training


@pytest.mark.slow
def test_the_commands_of_the_first_hour(here: Path, capsys: pytest.CaptureFixture[str]):
    page = (ROOT / "docs" / "first-hour.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```\n(.*?)^```$", page, re.M | re.S)
    commands = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    names = (*["record"] * 3, "validate", "birdseye", "towns", "train", "evaluate", "infer", "errors", "place")
    assert tuple(command[1] for command in commands) == names
    for command in commands:
        words = [{"60": "2", "100": "4", "12": "1"}.get(word, word) for word in command[1:]]
        with pytest.raises(SystemExit) as stopped:
            run(words)
        assert stopped.value.code == 0, (command, capsys.readouterr())
    assert re.search(r"cover \d+ of \d+ errors", capsys.readouterr().out)
    assert all((here / name).is_file() for name in ("frame.png", "town.png", "errors.png", "placed.png"))
