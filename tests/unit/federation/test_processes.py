"""Clients in processes of their own: the same rounds, and one that is killed is named."""

import os
import signal
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from regression import START, Regression, ledger, vehicles

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.link import open_client_processes
from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate, Weights

SCHEDULE = Schedule(rounds=1, steps=5, learning_rate=0.05, final_learning_rate=0.01, seed=3)


@dataclass
class Mortal(Regression):
    """Is killed by the system when it begins to train."""

    killed: bool = False

    def train(
        self,
        weights: Weights,
        *,
        steps: int,
        learning_rate: float,
        seed: int,
        own: Weights | None = None,
        imitation_steps: int = 0,
    ) -> LocalUpdate:
        if self.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        found = super().train({**weights, **(own or {})}, steps=steps, learning_rate=learning_rate, seed=seed)
        return found if own is None else replace(found, own=found.weights)


@pytest.mark.slow
def test_clients_in_two_processes_federate_to_the_same_bits_and_one_killed_is_named():
    clients = {name: Mortal(each.inputs, each.targets) for name, each in vehicles("grid", 4).items()}
    clients["grid/cav1"].killed = True
    account, state, rules = (
        Account(ledger(), "edge", "regression", "wireless"),
        FederationState(),
        Rules(least_clients=3),
    )
    with ClientProcesses(clients, 2) as processes:
        found = federate(clients, START, SCHEDULE, account, rules=rules, state=state, runtime=processes)
        own = FederationState()  # of clients that keep networks between rounds
        where = Account(ledger(), "edge", "regression", "wireless")
        asked: Any = (START, replace(SCHEDULE, rounds=3), where)
        keeping = federate(clients, *asked, strategy=FedMD(), rules=rules, state=own, runtime=processes)
    left = {name: client for name, client in clients.items() if name != "grid/cav1"}
    alone = Account(ledger(), "edge", "regression", "wireless")
    want = federate(left, START, SCHEDULE, alone)
    np.testing.assert_array_equal(found.weights["w"], want.weights["w"])
    np.testing.assert_array_equal(keeping.weights["w"], federate(left, *asked, strategy=FedMD()).weights["w"])
    assert set(own.clients) == set(left)
    assert [record.clients for record in state.records] == [tuple(left)]
    assert state.records[0].failed == {"grid/cav1": "ClientKilled('its process was killed while it trained')"}
    assert [each for each in account.ledger.entries if each.client != "grid/cav1"] == [*alone.ledger.entries]


def federate_regions(runtime: ClientProcesses | None, clients: dict[str, Regression]) -> tuple[Weights, Any]:
    """Federate as stage III does: two cloud rounds of two regions, each with two edge rounds of its vehicles."""
    book = ledger()
    own = {town: {name: each for name, each in clients.items() if name.startswith(town)} for town in ("grid", "ring")}
    account = Account(book, "cloud", "regression", "wireless")
    servers = {town: EdgeServer(each, 2, account, START, runtime=runtime) for town, each in own.items()}
    found = federate(servers, START, replace(SCHEDULE, rounds=2), Account(book, "cloud", "regression", "wireline"))
    return found.weights, book.entries


def test_edge_servers_whose_vehicles_train_in_two_processes_federate_to_the_same_bits():
    clients = {**vehicles("grid", 3), **vehicles("ring", 2)}
    with ClientProcesses(clients, 2) as processes:
        weights, entries = federate_regions(processes, clients)
        wanted, booked = federate_regions(None, clients)
        assert processes.pids
        for each in clients.values():
            each.targets = -each.targets
        processes.renew(clients)
        turned, _ = federate_regions(processes, clients)
    np.testing.assert_array_equal(weights["w"], wanted["w"])
    assert entries == booked
    np.testing.assert_array_equal(turned["w"], federate_regions(None, clients)[0]["w"])
    assert not np.array_equal(turned["w"], wanted["w"])


def test_clients_that_cannot_be_sent_are_refused_or_train_in_this_process():
    clients = {"cav0": Regression(np.zeros((1, 3)), (lambda: 0))}  # type: ignore[arg-type]
    with open_client_processes(clients, 2) as processes:
        assert processes is None
    with pytest.raises(InputError, match="clients cannot be sent to processes"):
        ClientProcesses(clients, 2)
