"""Whatever is killed in the middle of a round, the federation ends with the weights of one that nothing happened to."""

import os
import signal
import sqlite3
import threading

import numpy as np
import pytest
from fleet_clients import Walker
from flwr.proto.control_pb2 import StartRunRequest
from flwr.proto.fab_pb2 import Fab

from flcav.federation.loop import Schedule, federate
from flcav.federation.state import FederationState
from flcav.federation.strategies import strategy_named
from flcav.fleet.superlink import DATABASE, build_bundle
from flcav.fleet.supervisor import read_processes

SCHEDULE = Schedule(3, 2, 0.1, 0.05, 7)
NODE = "vehicle-002-supernode"


@pytest.mark.parametrize("killed", ["superlink", "proxy", "vehicle-001-forwarder", NODE, "vehicle-003-executor"])
def test_killed_in_mid_round(killed, weights, deployment, tmp_path):
    clients = {f"town/cav{n}": Walker(n + 1, tmp_path / "log", lasts_s=1.5) for n in range(3)}
    strategy = strategy_named("scaffold")  # whose clients keep arrays: a training done twice would show
    expected = federate({n: Walker(c.samples) for n, c in clients.items()}, weights, SCHEDULE, strategy=strategy)
    before = read_processes(deployment.folder)[killed]

    def kill():
        while len((tmp_path / "log").read_text().splitlines()) < 4:  # a client of the second round trains
            threading.Event().wait(0.05)
        os.kill(before, signal.SIGKILL)

    def start(number, _):
        if number == 2:
            threading.Thread(target=kill, daemon=True).start()

    ended = federate(clients, weights, SCHEDULE, strategy=strategy, runtime=deployment, before_round=start)
    assert read_processes(deployment.folder)[killed] != before
    for name, array in expected.weights.items():
        np.testing.assert_array_equal(array, ended.weights[name])


def test_an_app_that_is_ended_before_it_answers(weights, deployment, tmp_path):
    """Flower's SuperNode would wait for it without end."""
    clients = {f"town/cav{n}": Walker(n + 1, tmp_path / "log", lasts_s=3.0) for n in range(3)}
    expected = federate({n: Walker(c.samples) for n, c in clients.items()}, weights, SCHEDULE)
    ended = []

    def end():
        while len(trainings := (tmp_path / "log").read_text().splitlines()) < 4:  # a client of the second round trains
            threading.Event().wait(0.05)
        ended.append(int(trainings[3].split()[1]))
        os.kill(ended[0], signal.SIGTERM)

    def start(number, _):
        if number == 2:
            threading.Thread(target=end, daemon=True).start()

    state = FederationState()
    found = federate(clients, weights, SCHEDULE, state=state, runtime=deployment, before_round=start)
    assert [record.failed for record in state.records] == [{}] * 3
    np.testing.assert_array_equal(expected.weights["w"], found.weights["w"])


def test_a_run_that_was_begun_and_left_is_ended(weights, deployment, clients):
    """As of a command that is killed between the begin of a run and its task."""
    with deployment.link._control() as control:
        control.StartRun(StartRunRequest(fab=Fab(content=build_bundle())))
    ended = federate(clients, weights, SCHEDULE, runtime=deployment)
    np.testing.assert_array_equal(federate(clients, weights, SCHEDULE).weights["w"], ended.weights["w"])


def test_superlink_that_cannot_write(weights, deployment, tmp_path):
    """Its database is locked for some seconds, so that it fails calls, and messages are lost on their way."""
    clients = {f"town/cav{n}": Walker(n + 1, tmp_path / "log", lasts_s=1.0) for n in range(3)}
    expected = federate({n: Walker(c.samples) for n, c in clients.items()}, weights, SCHEDULE)
    held = threading.Event()

    def hold():
        while not (tmp_path / "log").exists() or len((tmp_path / "log").read_text().splitlines()) < 4:
            threading.Event().wait(0.05)
        connection = sqlite3.connect(deployment.folder / DATABASE, timeout=30.0, isolation_level=None)
        connection.execute("BEGIN IMMEDIATE")
        held.set()
        threading.Event().wait(12.0)  # longer than SQLite's writers wait
        connection.execute("ROLLBACK")
        connection.close()

    threading.Thread(target=hold, daemon=True).start()
    ended = federate(clients, weights, SCHEDULE, runtime=deployment)
    assert held.is_set()
    np.testing.assert_array_equal(expected.weights["w"], ended.weights["w"])
