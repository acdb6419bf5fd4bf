"""What the pages tell to type exists: commands, their options, the recipe and the strategy of the tutorials."""

import re
from pathlib import Path

import commands_page
import numpy as np
import pytest
import typer

from flcav import load_run_recipe
from flcav.cli.main import app
from flcav.federation import LocalUpdate

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = dict(commands_page.commands_of(typer.main.get_command(app)))


def typed(text: str) -> list[str]:
    """Return the lines of code blocks that call flcav, without their comments."""
    blocks = re.findall(r"^```(?:console)?\n(.*?)^```$", text, re.M | re.S)
    lines = re.findall(r"^(?:\$ )?flcav (.*)$", "".join(blocks), re.M) + re.findall(r"^ {4}flcav (.*)$", text, re.M)
    return [re.split(r"\s+#|\s*\|\s", line)[0] for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_tells_to_type_is_a_command_with_these_options(page: Path):
    for line in typed(page.read_text(encoding="utf-8")):
        name = next((name for name in COMMANDS if f"{line} ".startswith(f"{name} ")), None)
        assert name is not None, line
        known = {option for parameter in COMMANDS[name].params for option in parameter.opts} | {"--help"}
        assert {word for word in line.split() if word.startswith("--")} <= known, line


def test_pages_tell_much_to_type():
    assert sum(len(typed(page.read_text(encoding="utf-8"))) for page in PAGES) > 80


def test_the_recipe_of_the_tutorial_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    page = (ROOT / "docs" / "own-task.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.M | re.S)
    (tmp_path / "own.yaml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(ROOT / "examples")
    recipe = load_run_recipe(tmp_path / "own.yaml")
    assert [*recipe.tasks] == ["05_bring_your_own_task:TASK"]


def test_the_strategy_that_is_shown_is_one():
    page = (ROOT / "docs" / "how-to.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(# mine.py.*?|[^`]*class .*?)^```$", page, re.M | re.S)
    names: dict = {"__name__": "mine"}
    exec(compile(code, "how-to.md", "exec"), names)
    updates = [LocalUpdate({"w": np.full(2, float(i))}, samples=1, loss=float(i)) for i in (1, 2)]
    assert names["LossWeighted"]().combine({}, updates)["w"] == pytest.approx([9 / 5] * 2)
