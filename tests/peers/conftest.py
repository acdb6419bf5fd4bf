"""Exports read by the software that they are for, each in an environment of its own: `make test-peers`.

A peer NAME is what `requirements/NAME.txt` pins (and `NAME-alone.txt`, installed without what it asks for), built once
in `out/peers/NAME`. `readers/read_NAME.py` runs there and answers with JSON in its last line; tests import no peer.
"""

import json
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

HERE = Path(__file__).parent
PEERS = HERE.parents[1] / "out" / "peers"
STREETS = """
town: suburb
seed: 4
scenes: 2
warmup_s: 60.0
spins_per_scene: 12
every_s: 2.0
cavs: 1
vehicle_rig: kitti
"""
DESERTED = """
town: arterial
seed: 1
scenes: 2
warmup_s: 0.1  # nobody has come yet
spins_per_scene: 2
every_s: 0.5
cavs: 1
vehicle_rig: kitti
"""
TOGETHER = """
town: grid
seed: 12
scenes: 2
frames: 30  # the last spin of the second scene lacks two agents
warmup_s: 60.0
spins_per_scene: 4
every_s: 0.5
cavs: 3
poles: [2]
vehicle_rig: car
"""


@dataclass(frozen=True)
class Peer:
    """Somebody else's software and the script that reads our files by it."""

    name: str
    python: Path

    def read(self, *arguments: str | Path, **environment: str) -> Any:
        script = HERE / "readers" / f"read_{self.name}.py"
        ran = subprocess.run(
            [self.python, script, *arguments],
            capture_output=True,
            text=True,
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | environment,
        )
        assert ran.returncode == 0, f"{self.name}: {ran.stdout[-2000:]}\n{ran.stderr[-4000:]}"
        return json.loads(ran.stdout.splitlines()[-1])


def _environment(name: str) -> Path:
    """Return the Python of a peer's environment, built where it is missing or its pins have changed."""
    folder, pins = PEERS / name, HERE / "requirements" / f"{name}.txt"
    alone = pins.with_name(f"{name}-alone.txt")
    wanted = "".join(path.read_text() for path in (pins, alone) if path.is_file())
    installed = folder / "installed.txt"
    python = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    if not installed.is_file() or installed.read_text() != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        venv.create(folder, with_pip=True)
        pip = [python, "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, "--requirement", pins], check=True)
        if alone.is_file():
            subprocess.run([*pip, "--no-deps", "--requirement", alone], check=True)
        installed.write_text(wanted)
    return python


def build_peer(name: str) -> Peer:
    """Return the peer of that name, its environment built where it has to be."""
    return Peer(name, _environment(name))


@pytest.fixture(scope="session")
def peer() -> Callable[[str], Peer]:
    return build_peer


@pytest.fixture(scope="session")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """One vehicle with KITTI's sensors."""
    return _record(STREETS, tmp_path_factory.mktemp("streets"))


@pytest.fixture(scope="session")
def deserted(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The same in an empty town: of some frames nothing is labelled."""
    return _record(DESERTED, tmp_path_factory.mktemp("deserted"))


@pytest.fixture(scope="session")
def together(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Three vehicles and a pole; the second scene ends in the middle of a spin."""
    return _record(TOGETHER, tmp_path_factory.mktemp("together"))


def _record(recipe: str, folder: Path) -> Dataset:
    record(EmbeddedSource(parse_config(Recipe, yaml.safe_load(recipe), "recipe")), folder)
    return Dataset.open(folder)
