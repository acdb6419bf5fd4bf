"""Each region has a fleet of its own, or its vehicles are beside those of the others."""

from dataclasses import asdict
from typing import Any

import pytest

from flcav.config import InputError
from flcav.federation.fleet.authority import found_authority
from flcav.federation.fleet.up import READY, Ready
from flcav.federation.runtimes.deployed import Deployment, RegionalDeployment
from flcav.storage.files import write_json


class Opened(Exception):
    """Says which fleet was asked, and how many of its vehicles are other regions'."""


@pytest.fixture
def fleets(tmp_path, monkeypatch):
    for folder in (tmp_path, tmp_path / "grid"):
        found_authority(folder)
        write_json(folder / READY, asdict(Ready("127.0.0.1:1", "127.0.0.1:2", 1, 1)))

    def tell(self, clients, *_):
        raise Opened(self.folder, self.first, [*clients])

    monkeypatch.setattr(Deployment, "open", tell)
    return tmp_path


@pytest.mark.parametrize(("region", "folder", "first"), [("ring", ".", 0), ("grid", "grid", 0), ("suburb", ".", 2)])
def test_region_has_its_vehicles(region, folder, first, fleets):
    deployment: Any = RegionalDeployment(fleets, {"ring": 2, "grid": 3, "suburb": 1})
    with pytest.raises(Opened) as told:
        deployment.open({f"{region}/cav0": None}, None, {}, None)
    assert told.value.args == (fleets / folder, first, [f"{region}/cav0"])


def test_fleet_that_is_not_up(fleets):
    (fleets / "grid" / READY).unlink()
    with pytest.raises(InputError, match="grid: the fleet is not up"):
        RegionalDeployment(fleets, {"ring": 2, "grid": 3})
