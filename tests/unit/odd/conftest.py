from pathlib import Path

import pytest
import yaml

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.odd.domain import Domain, read_domain
from flcav.odd.scenery import Scenery
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.town import load_town

DRIVE = """
town: ring
seed: 3
scenes: 2
warmup_s: 12.0
spins_per_scene: 3
every_s: 0.5
cavs: 2
weather: {classes: [clear, night]}
vehicle_rig: {lidars: {lidar: {mount: {z: 1.8}, settings: {channels: 8, azimuth_steps: 90}}}}
"""


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two vehicles through two scenes."""
    folder = tmp_path_factory.mktemp("drive")
    record(EmbeddedSource(parse_config(Recipe, yaml.safe_load(DRIVE), "recipe")), folder)
    return Dataset.open(folder)


@pytest.fixture(scope="session")
def ring() -> Scenery:
    return Scenery(load_town("ring"))


@pytest.fixture(scope="session")
def urban() -> Domain:
    return read_domain("urban")


@pytest.fixture
def odd_file(tmp_path: Path):
    """Write an OpenODD file and return its path."""

    def write(text: str, name: str = "own.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write
