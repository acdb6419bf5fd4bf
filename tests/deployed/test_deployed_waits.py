"""A federation on a fleet of its own: a vehicle hangs, another is revoked, the registry is damaged; it goes on."""

import contextlib
import os
import signal
import sqlite3
import threading
import time

import httpx
import pytest
from fleet_clients import Walker
from test_deployed_refusals import activate, reach
from waiting import wait_for

from flcav.federation.links import flower_grid
from flcav.federation.links.flower import start_fleet
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import ReplyLimits, Rules
from flcav.federation.state import FederationState
from flcav.fleet.authority import REGISTRY, open_authority
from flcav.fleet.keys import KEY, load_key
from flcav.fleet.status import read_fleet_status
from flcav.fleet.supervisor import read_processes
from flcav.fleet.up import VEHICLES

SCHEDULE = Schedule(3, 2, 0.1, 0.05, 7)


@pytest.fixture(scope="module")
def fleet(importable):
    with start_fleet(3) as found:
        yield found


def follow(fleet, weights, clients, log, rules, in_second_round):
    """Return the records of a federation of three rounds, in whose second one a function is called, and their ends."""
    state, begun, ends = FederationState(), threading.Event(), []

    def watch():
        begun.wait()
        wait_for(lambda: len(log.read_text().splitlines()) > 3)  # a client of the second round trains
        in_second_round()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()

    def start(number, _):
        ends.append(time.monotonic())
        if number == 2:
            begun.set()

    federate(clients, weights, SCHEDULE, rules=rules, state=state, runtime=fleet, before_round=start)
    thread.join()
    return state.records, [*ends, time.monotonic()]


def test_a_vehicle_that_hangs(fleet, weights, tmp_path, monkeypatch):
    """All its processes stop, so that it cannot keep the limit itself; the server's own ends the wait for it."""
    monkeypatch.setattr(flower_grid, "ALLOWANCE_S", 30.0)
    log = tmp_path / "log"
    clients = {f"town/cav{n}": Walker(n + 1, log, lasts_s=2.0) for n in range(3)}
    stopped = []

    def stop():
        stopped.extend(pid for name, pid in read_processes(fleet.folder).items() if name.startswith("vehicle-003"))
        stopped.extend(int(pid) for samples, pid in map(str.split, log.read_text().splitlines()) if samples == "3")
        for pid in [*stopped]:
            try:
                os.kill(pid, signal.SIGSTOP)
            except ProcessLookupError:  # of the first round
                stopped.remove(pid)

    try:
        rules = Rules(limits=ReplyLimits(train_s=10.0))
        records, ends = follow(fleet, weights, clients, log, rules, stop)
    finally:
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
    assert records[0].failed == {}
    assert records[1].failed == {"town/cav2": "it had not answered after 40 s"}
    assert [len(record.clients) for record in records] == [3, 2, 2]
    assert ends[-1] - ends[1] < 180  # of two rounds
    federation = read_fleet_status(fleet.folder).federation
    assert federation is not None
    assert "round 3 without town/cav2: " in federation.describe()


def test_a_damaged_registry_closes_calls_and_not_the_fleet(fleet, tmp_path):
    own, path, before = fleet.folder / VEHICLES / "vehicle-001", fleet.folder / REGISTRY, read_processes(fleet.folder)
    with (
        contextlib.closing(sqlite3.connect(path)) as now,
        contextlib.closing(sqlite3.connect(tmp_path / "kept")) as kept,
    ):
        now.backup(kept)
    (tmp_path / "none").write_text("no registry")
    try:
        (tmp_path / "none").replace(path)
        for rest in ("-wal", "-shm"):  # what SQLite would restore it from
            path.with_name(path.name + rest).unlink(missing_ok=True)
        with reach(fleet, own) as client:
            answer = activate(client, load_key(own / KEY))
            assert (answer.status_code, answer.text) == (503, "the fleet's registry cannot be read")
            time.sleep(2.5)  # in which the supervisor looks at it
    finally:
        (tmp_path / "kept").replace(path)
    with reach(fleet, own) as client:
        assert activate(client, load_key(own / KEY)).status_code in (httpx.codes.OK, 412)  # 412: it is in
    after = read_processes(fleet.folder)
    assert {name: after[name] for name in ("superlink", "proxy")} == {
        name: before[name] for name in ("superlink", "proxy")
    }


def test_a_vehicle_that_is_revoked(fleet, weights, tmp_path):
    """In mid-round the wait for it ends, and the next round does not ask it."""
    clients = {f"town/cav{n}": Walker(n + 1, tmp_path / "log", lasts_s=3.0) for n in range(3)}
    took = []

    def revoke():
        open_authority(fleet.folder).registry.revoke("vehicle-002", "stolen")
        begun = time.monotonic()
        wait_for(lambda: (found := read_fleet_status(fleet.folder).federation) is not None and found.gone)
        took.append(time.monotonic() - begun)

    records, ends = follow(fleet, weights, clients, tmp_path / "log", Rules(), revoke)
    told = "the certificate of vehicle-002 is revoked"
    assert [record.failed for record in records[1:]] == [{"town/cav1": told}] * 2
    assert took[0] < 5  # a second, and the time that a status takes on a busy machine
    assert ends[3] - ends[2] < 60
    federation = read_fleet_status(fleet.folder).federation
    assert federation is not None
    assert f"without town/cav1: {told}" in federation.describe()
