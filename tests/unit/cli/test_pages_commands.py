"""What the pages tell to type exists: commands, their options, the recipe and the strategy of the tutorials."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import commands_page
import numpy as np
import pytest
import typer

from flcav import load_run_recipe
from flcav.cli.main import app
from flcav.config import InputError
from flcav.federation import LocalUpdate, Update
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import Rules
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Weights
from flcav.network.ledger import Ledger, LinkMegabytes

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
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
    page = (ROOT / "docs" / "own-strategy.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(from collections[^`]*class .*?)^```$", page, re.M | re.S)
    names: dict = {"__name__": "mine"}
    exec(compile(code, "own-strategy.md", "exec"), names)
    updates = [LocalUpdate({"w": np.full(2, float(i))}, samples=1, loss=float(i)) for i in (1, 2)]
    assert names["LossWeighted"]().combine({}, updates)["w"] == pytest.approx([9 / 5] * 2)


class Fixed:
    """A client whose update is a fixed number."""

    def __init__(self, value: float) -> None:
        self.value = value

    def train(self, weights: Weights, **how: Any) -> LocalUpdate:
        return LocalUpdate({"w": np.full(4, self.value)}, 1, self.value)


class Unable:
    """A strategy that cannot combine what it is given."""

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        raise ValueError("no mean of these")


@pytest.mark.parametrize("privacy", [None, Privacy(clip=1.0, noise=1.0, seeded=True)])
def test_the_strategy_that_is_shown_runs_under_central_noise_and_one_that_fails_is_a_sentence(privacy: Privacy | None):
    page = (ROOT / "docs" / "own-strategy.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(from collections[^`]*class .*?)^```$", page, re.M | re.S)
    names: dict = {"__name__": "mine"}
    exec(compile(code, "own-strategy.md", "exec"), names)
    start, schedule = {"w": np.zeros(4)}, Schedule(1, 1, 0.1, 0.1, seed=1)
    clients = {f"cav{i}": Fixed(float(i)) for i in range(1, 4)}

    def run(strategy: Strategy) -> Weights:
        account = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "walk", "wireless")
        rules = Rules(privacy=privacy)
        return federate(clients, start, schedule, account, strategy=strategy, rules=rules).weights

    assert run(names["LossWeighted"]())["w"].any()
    with pytest.raises(InputError, match="strategy Unable, round 1: no mean of these"):
        run(Unable())
