import shutil
from pathlib import Path

import pytest
from release_drives import make_frame
from release_parties import Parties, write_weights

from flcav.releases.checking import trust_roots
from flcav.releases.proposal import propose
from flcav.releases.repositories.metadata import read_root
from flcav.releases.repositories.repository import create_repository
from flcav.sensors.frame import Frame


@pytest.fixture(scope="session")
def first_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two candidates; the first is released, and a vehicle drives it."""
    parties = Parties(tmp_path_factory.mktemp("parties"))
    for number in (1, 2):
        write_weights(parties.folder / f"{number}.safetensors", number)
        weights, driving = (parties.folder / f"{each}.safetensors" for each in (number, 1))
        propose(parties.candidate(number), weights, driving, number, "better", "all vehicles")
    create_repository(parties.image, "provider")
    create_repository(parties.director, "customer")
    parties.release("image", 1)
    parties.release("director", 1)
    trust_roots(parties.vehicle, read_root(parties.image), read_root(parties.director))
    installed = parties.update()
    assert installed is not None
    assert installed.release == 1
    return parties.folder


@pytest.fixture
def parties(first_release: Path, tmp_path: Path) -> Parties:
    """A copy of `first_release`, to be attacked."""
    shutil.copytree(first_release, tmp_path / "parties", symlinks=True)
    return Parties(tmp_path / "parties")


@pytest.fixture(scope="session")
def recorded_frame() -> Frame:
    """A frame of a LiDAR with a car that drives east at 10 m/s."""
    return make_frame()
