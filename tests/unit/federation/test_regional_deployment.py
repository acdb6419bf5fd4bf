"""Each region has a fleet of its own, or its vehicles are beside those of the others."""

from dataclasses import asdict, dataclass, field
from typing import Any

import pytest

from flcav.config import InputError
from flcav.federation.links import flower
from flcav.federation.links.flower import Deployment, RegionalDeployment
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG
from flcav.fleet.authority import found_authority
from flcav.fleet.fl_request import make_request
from flcav.fleet.up import READY, Ready
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


@dataclass(frozen=True)
class Registered:
    """A registered vehicle."""

    name: str
    node: int

    def describe_state(self):
        return "registered"


@dataclass
class Fleet:
    """Registry and SuperLink of a fleet with vehicles a, b and c."""

    online: set[int] = field(default_factory=lambda: {1, 2, 3})
    requests: list[tuple[str, bytes]] = field(default_factory=list)

    def list_vehicles(self):
        return [Registered(name, node) for node, name in enumerate("abc", start=1)]

    def list_online(self):
        return self.online

    def list_open_requests(self, since):
        return self.requests

    def close(self):
        pass


@pytest.fixture
def one(fleets, monkeypatch):
    fleet: Any = Fleet()
    monkeypatch.setattr(flower, "open_registry", lambda _: fleet)
    monkeypatch.setattr(flower, "STARTING_S", 0.0)
    monkeypatch.setattr(flower, "STARTING_VEHICLE_S", 0.0)
    deployment: Any = Deployment(fleets)
    deployment.link = fleet
    return deployment, fleet


def enter(deployment, *clients):
    """Return the vehicles of clients, as they come in."""
    return [own.name for own in deployment.choose_vehicles([*clients])]


def test_a_client_keeps_its_vehicle(one):
    deployment, fleet = one
    assert enter(deployment, "r/1", "r/2") == ["a", "b"]
    assert enter(deployment, "r/2") == ["b"]
    assert enter(deployment, "r/2", "r/3") == ["b", "a"]
    fleet.online = {1, 3}  # its vehicle does not come back
    assert enter(deployment, "r/1", "r/2") == ["a", "c"]
    fleet.online = {1}
    with pytest.raises(OSError, match="fewer than 2 vehicles are in"):
        enter(deployment, "r/1", "r/2")


def test_vehicles_that_come_in_late_are_waited_for(one, monkeypatch):
    deployment, fleet = one
    monkeypatch.setattr(flower, "STARTING_S", 30.0)
    monkeypatch.setattr(flower, "LOOK_S", 0.0)
    coming = iter([set(), {3}, {2, 3}])
    fleet.list_online = lambda: next(coming)
    assert enter(deployment, "r/1", "r/2") == ["b", "c"]


def test_each_client_is_reached_at_the_node_of_its_vehicle(one, monkeypatch):
    deployment, fleet = one
    fleet.online, reached = {2, 3}, []

    class Grid:
        def __init__(self, folder, link, names, vehicles, *_):
            reached.append((names, {node: own.name for node, own in vehicles.items()}))

        def end(self, failed=False):
            pass

    monkeypatch.setattr(flower, "DeployedGrid", Grid)
    agreed: Any = flower.ClientAgreement(FEDAVG, Rules(), {}, 0)
    with deployment._open({"r/1": None, "r/2": None}, agreed, {}, None):
        assert reached == [({2: "r/1", 3: "r/2"}, {2: "b", 3: "c"})]


def test_fl_requests_of_the_vehicles_of_clients(one):
    deployment, fleet = one
    enter(deployment, "r/1", "r/2")
    sent = [make_request(task, loss, 1, (0.0, 0.0)).as_bytes() for task in ("weather", "signs") for loss in (1.0, 2.0)]
    fleet.requests = [("b", sent[0]), ("b", sent[1]), ("b", sent[2]), ("c", sent[0])]
    assert deployment.list_requests(["r/1", "r/2"], "weather") == {"r/2": (sent[0], sent[1])}
    assert deployment.list_requests(["r/2"], "signs") == {"r/2": (sent[2],)}


def test_fleet_that_is_not_up(fleets):
    (fleets / "grid" / READY).unlink()
    with pytest.raises(InputError, match="grid: the fleet is not up"):
        RegionalDeployment(fleets, {"ring": 2, "grid": 3})
