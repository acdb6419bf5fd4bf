"""Clients that do not end their training: with a time limit the round goes on without them, in every runtime."""

import threading
import time
from typing import Any

import numpy as np
import pytest

from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.in_process import ClientLate, limit_time
from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import ReplyLimits, Rules
from flcav.federation.state import FederationState
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Ledger, LinkMegabytes

START = {"w": np.zeros(3)}
SCHEDULE = Schedule(2, 1, 0.1, 0.1, 1)


class Vehicle:
    def __init__(self, stalls_s: float = 0.0) -> None:
        self.stalls_s = stalls_s

    def train(self, weights: Weights, *, seed: int, **_: Any) -> LocalUpdate:
        time.sleep(self.stalls_s)
        return LocalUpdate({"w": weights["w"] + np.random.default_rng(seed).normal(size=3)}, 2, 0.5)


def fleet(stalls_s: float) -> dict[str, Vehicle]:
    return {f"cav{i}": Vehicle(stalls_s if i == 2 else 0.0) for i in range(5)}


def run(clients: dict[str, Vehicle], limit_s: float | None, **how: Any) -> tuple[Weights, FederationState]:
    state, account = FederationState(), Account(Ledger(LinkMegabytes(9.0, 9.0)), "edge", "toy", "wireless")
    rules = Rules(limits=ReplyLimits(train_s=limit_s))
    return federate(clients, START, SCHEDULE, account, rules=rules, state=state, **how).weights, state


def check(weights: Weights, state: FederationState) -> None:
    assert [record.failed for record in state.records] == [
        {"cav2": "ClientLate('it had not trained after 0.3 s')"}
    ] * SCHEDULE.rounds
    others = {name: client for name, client in fleet(0.0).items() if name != "cav2"}
    np.testing.assert_array_equal(weights["w"], run(others, None)[0]["w"])


def test_a_client_that_stalls_in_this_process_is_left_behind_and_not_asked_again():
    begun, before = time.monotonic(), threading.active_count()
    check(*run(fleet(3600.0), 0.3))
    assert time.monotonic() - begun < 5
    assert threading.active_count() == before + 1  # of one training, in two rounds


def test_a_client_that_stalls_in_a_process_of_its_own_is_ended():
    clients = fleet(3600.0)
    with ClientProcesses(clients, 2) as processes:
        check(*run(clients, 0.3, runtime=processes))


def test_a_limit_that_nobody_reaches_changes_nothing():
    wanted, _ = run(fleet(0.0), None)
    found, state = run(fleet(0.0), 60.0)
    np.testing.assert_array_equal(found["w"], wanted["w"])
    assert all(not record.failed for record in state.records)


def test_vehicles_of_an_edge_server_have_their_own_time_and_the_server_none():
    rules = Rules(limits=ReplyLimits(train_s=0.3))
    assert rules.of_servers().limits.train_s is None
    account, state = Account(Ledger(LinkMegabytes(9.0, 9.0)), "cloud", "toy", "wireless"), FederationState()
    server = EdgeServer(fleet(3600.0), 2, account, START, rules=rules, state=state)
    federate({"grid": server}, START, Schedule(1, 1, 0.1, 0.1, 1), account, rules=rules.of_servers())
    assert [{*record.failed} for record in state.records] == [{"cav2"}] * 2


def test_a_client_is_asked_again_when_it_has_ended_and_raises_what_it_raises():
    class Odd:
        def train(self, weights: Weights, **_: Any) -> LocalUpdate:
            raise TimeoutError("its own")

        def count_samples(self, steps: int) -> int:
            return steps

    slow = Vehicle(0.4)
    clients = limit_time({"slow": slow, "odd": Odd()}, 0.1)
    assert [*clients] == ["slow", "odd"]
    how: Any = {"steps": 1, "learning_rate": 0.1, "seed": 1}
    for _ in range(2):
        with pytest.raises(ClientLate, match=r"it had not trained after 0.1 s"):
            clients["slow"].train(START, **how)
    slow.stalls_s = 0.0
    time.sleep(0.6)
    assert clients["slow"].train(START, **how).samples == 2
    with pytest.raises(TimeoutError, match="its own"):
        clients["odd"].train(START, **how)
    assert clients["odd"].count_samples(3) == 3  # type: ignore[attr-defined]
