"""Hints about what is not installed work where flcav is on no index: they name the packages, as the project does."""

import importlib.util
import shlex
import sys
import tomllib
from pathlib import Path
from xml.etree.ElementTree import Element

import pytest
from packaging.requirements import Requirement

from flcav.config import InputError
from flcav.dataset.recording.jobs import start_actors
from flcav.interface.wording import format_install_command
from flcav.world.opendrive import netconvert

PROJECT = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("extra", ["ray", "view", "towns"])
def test_it_names_the_packages_that_the_project_asks_for(extra):
    command = shlex.split(format_install_command(extra))
    assert command[:4] == [sys.executable, "-m", "pip", "install"]
    asked = {Requirement(line) for line in PROJECT["optional-dependencies"][extra]}
    assert {Requirement(word) for word in command[4:]} == asked
    assert not any("flcav" in word for word in command[4:])


def test_ray_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError) as told, start_actors(None, tmp_path, 1, lambda count: None):  # type: ignore
        pass
    assert str(told.value).endswith(format_install_command("ray"))


def test_importing_towns_says_how_to_get_netconvert(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError) as told:
        netconvert.split_map(Element("OpenDRIVE"), tmp_path / "parts", tmp_path / "map.xodr", left_hand=False)
    assert str(told.value).endswith(format_install_command("towns"))
