"""Weights that come with the package: small, loadable, and their cards say how they came about."""

import shutil
from pathlib import Path
from typing import get_type_hints

import pytest

from flcav import perception
from flcav.cli.main import run
from flcav.config import InputError
from flcav.perception.networks import resolve_network
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.training.checkpoint import find_finished_card, settings_of
from flcav.perception.weights import LICENCE, SHIPPED, find_shipped, read_card, to_arrays

EACH_MB, ALL_MB = 4.0, 12.0
FOLDER = Path(next(iter(perception.__path__)))
SENT = {name: task_named(name) for name in TASKS if (FOLDER / name / SHIPPED).is_file()}
NOT_SENT = {name: task_named(name) for name in TASKS if name not in SENT}


def test_they_are_small():
    sizes = {path: path.stat().st_size / 1e6 for path in FOLDER.glob("*/shipped/*")}
    assert sum(sizes.values()) <= ALL_MB
    assert max(sizes.values(), default=0.0) <= EACH_MB
    assert {path.parent.parent.name for path in sizes} <= set(TASKS)


def shapes(network):
    return {name: array.shape for name, array in to_arrays(network).items()}


@pytest.mark.parametrize("task", SENT.values(), ids=SENT)
def test_they_load_and_their_card_says_how_they_came_about(task):
    path = find_shipped(task)
    network, card = resolve_network(task, None), read_card(path)
    assert card.task == task.name
    assert shapes(network) == shapes(task.build(task.configurations[card.network]))
    assert card.parameters == sum(parameter.numel() for parameter in network.parameters())
    assert card.licence == LICENCE
    assert card.seed >= 0
    assert card.samples > 0
    if (
        "averaged" in card.training
    ):  # a mean of weights, which has the steps of all its trainings and begins with a network
        averaged, steps = card.training["averaged"], card.training["steps"]
        assert isinstance(averaged, int)
        assert averaged > 1
        assert isinstance(steps, int)
        assert steps > 0
        assert len(str(card.training["begun_with"])) == 64
    else:
        assert settings_of(card).epochs > 0
    assert all(entry.recipe["town"] and entry.frames > 0 for entry in card.data)
    assert card.data
    evaluation = get_type_hints(task.evaluate)["return"]
    assert 0 < evaluation.from_json(card.metrics, "card").score <= 1
    assert path.with_name("card.md").read_text(encoding="utf-8") == card.markdown()


@pytest.mark.parametrize("task", NOT_SENT.values(), ids=NOT_SENT)
def test_where_there_are_none_one_sentence_says_so(task, tmp_path, capsys):
    with pytest.raises(InputError, match=f"no weights of '{task.family}' come with the package"):
        find_shipped(task)
    with pytest.raises(SystemExit, match="2"):
        run(["infer", task.name, str(tmp_path)])
    assert capsys.readouterr().err.count("\n") == 1


def test_a_mean_of_networks_is_not_overwritten(tmp_path):
    shipped = find_shipped(task_named("objects"))
    for path in (shipped, shipped.with_name("card.md")):
        shutil.copy(path, tmp_path)
    with pytest.raises(InputError, match="a mean of the weights of several trainings; choose another folder"):
        find_finished_card(tmp_path / shipped.name, settings_of(read_card(find_shipped(task_named("signs")))))
