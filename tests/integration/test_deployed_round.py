"""One deployed round: SuperLink, proxy and two vehicles, to the weights of the federation in this process."""

import os
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from waiting import read_all_traffic

from flcav.federation.links.flower import start_fleet
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.fleet.status import read_fleet_status
from flcav.network.ledger import Ledger, LinkMegabytes

CLIENTS = Path(__file__).parents[1] / "deployed"  # `make test-deployed` has the other tests of a fleet


@pytest.mark.slow
def test_a_deployed_round_ends_with_the_embedded_weights(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(CLIENTS), os.environ.get("PYTHONPATH", "")]).rstrip(":"))
    monkeypatch.syspath_prepend(str(CLIENTS))
    Walker = import_module("fleet_clients").Walker

    clients = {"town/cav0": Walker(1), "town/cav1": Walker(3)}
    weights, schedule = {"w": np.arange(3000, dtype=np.float32)}, Schedule(1, 2, 0.1, 0.1, 5)
    expected = federate(clients, weights, schedule)
    account = Account(Ledger(LinkMegabytes(10, 10)), "edge", "walk", "wireless")
    with start_fleet(len(clients)) as deployment:
        found = federate(clients, weights, schedule, account, runtime=deployment)
        sent = {direction: account.ledger.used_bytes("wireless", direction=direction) for direction in ("up", "down")}
        read_all_traffic(deployment.folder)
        told = read_fleet_status(deployment.folder)
    np.testing.assert_array_equal(expected.weights["w"], found.weights["w"])
    assert [own.online for own in told.vehicles] == [True, True]
    assert told.federation is not None
    assert [each.clients for each in told.federation.rounds] == [2]
    assert sum(own.content_up for own in told.vehicles) > sent["up"] * 0.9  # Flower compresses nothing
    assert sum(own.socket_up for own in told.vehicles) > sum(own.content_up for own in told.vehicles)
    assert sum(own.socket_down for own in told.vehicles) > sent["down"] * 0.9
