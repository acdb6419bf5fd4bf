"""Five hosts, each a network namespace with a loopback of its own: an operator's and four vehicles, on one bridge."""

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from run_walkers import walk
from waiting import LONGEST_S, wait_for

from flcav.fleet.authority import found_authority, open_authority
from flcav.fleet.keys import AUTHORITY, request_certificate
from flcav.fleet.superlink import TRUSTED, make_publisher
from flcav.fleet.up import READY, VEHICLES, read_ready
from flcav.fleet.vehicle import install_vehicle

HERE = Path(__file__).parent
OPERATOR, HUB, COUNT, PORT = "flcav-op", "flcav-hub", 4, 9443
NAMES = [f"cav-{number}" for number in range(1, COUNT + 1)]


def ip(*arguments, check=True):
    return subprocess.run(["ip", *arguments], capture_output=True, text=True, check=check)


def is_permitted():
    try:
        made = ip("netns", "add", "flcav-try", check=False).returncode == 0
    except FileNotFoundError:
        return False
    return made and ip("netns", "del", "flcav-try", check=False).returncode == 0


pytestmark = pytest.mark.skipif(not is_permitted(), reason="network namespaces are not permitted here")


@pytest.fixture(scope="module")
def hosts():
    """Yield after the namespaces of all hosts are there, with addresses 10.77.0.1 (the operator's) and so on."""
    every = [OPERATOR, *NAMES]
    with contextlib.ExitStack() as stack:
        for name in (HUB, *every):
            ip("netns", "del", name, check=False)
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name, check=False)
            ip("-n", name, "link", "set", "lo", "up")
        ip("-n", HUB, "link", "add", "br0", "type", "bridge")
        ip("-n", HUB, "link", "set", "br0", "up")
        for number, name in enumerate(every, 1):
            ip("-n", name, "link", "add", "eth0", "type", "veth", "peer", "name", f"to{number}", "netns", HUB)
            ip("-n", HUB, "link", "set", f"to{number}", "master", "br0", "up")
            ip("-n", name, "addr", "add", f"10.77.0.{number}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
        yield


@contextlib.contextmanager
def running(host, log, *command):
    """Yield a process in a host, which ends with the context."""
    with log.open("ab") as out:
        inside = ["ip", "netns", "exec", host, sys.executable, *map(str, command)]
        process = subprocess.Popen(inside, stdout=out, stderr=out, start_new_session=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()


@pytest.fixture(scope="module")
def fleet(hosts, tmp_path_factory):
    """Yield the folder of a fleet that is up on five hosts; vehicles' folders are linked from it, as if shared."""
    base = tmp_path_factory.mktemp("hosts")
    authority = found_authority(base / "fleet", ("10.77.0.1",))
    make_publisher(authority.folder)
    (authority.folder / VEHICLES).mkdir()
    with contextlib.ExitStack() as stack:
        up = ("-m", "flcav", "fleet", "up", authority.folder, "--host", "10.77.0.1", "--port", PORT)
        stack.enter_context(running(OPERATOR, base / "up.log", *up))
        for name in NAMES:
            own = base / name
            (base / f"{name}.crt").write_bytes(authority.register(request_certificate(own, name)))
            trusted = authority.folder / TRUSTED
            install_vehicle(own, base / f"{name}.crt", authority.folder / AUTHORITY, trusted, f"10.77.0.1:{PORT}")
            (authority.folder / VEHICLES / name).symlink_to(own)
        wait_for((authority.folder / READY).exists, tell=(base / "up.log").read_text)
        for name in NAMES:
            stack.enter_context(running(name, base / f"{name}.log", "-m", "flcav", "fleet", "vehicle", base / name))
        yield authority.folder


def reaches(host, address, port):
    """Return whether a host can connect to an address."""
    script = f"import socket; socket.create_connection(({address!r}, {port}), 3)"
    done = subprocess.run(["ip", "netns", "exec", host, sys.executable, "-c", script], capture_output=True, check=False)
    return done.returncode == 0


def test_vehicles_reach_the_proxy_alone(fleet):
    control = int(read_ready(fleet).superlink.rpartition(":")[2])
    assert reaches(OPERATOR, "127.0.0.1", control)
    assert reaches("cav-1", "10.77.0.1", PORT)
    assert not reaches("cav-1", "10.77.0.1", control)
    assert not reaches("cav-1", "127.0.0.1", control)


def test_radio_cut_in_mid_round(fleet, tmp_path):
    """A vehicle's link goes down while it trains, and comes up again: the weights are the embedded federation's."""
    expected = walk(None, COUNT, 3)
    log, out = tmp_path / "log", tmp_path / "out.npy"
    with running(OPERATOR, tmp_path / "run.log", HERE / "run_walkers.py", fleet, COUNT, 3, log, out) as process:
        wait_for(
            lambda: log.exists() and len(log.read_text().splitlines()) > COUNT, tell=(tmp_path / "run.log").read_text
        )
        ip("-n", "cav-2", "link", "set", "eth0", "down")
        time.sleep(8)
        ip("-n", "cav-2", "link", "set", "eth0", "up")
        process.wait(LONGEST_S)
    assert process.returncode == 0, (tmp_path / "run.log").read_text()
    found = np.load(out)
    np.testing.assert_array_equal(expected["w"], found)
    assert {own.name for own in open_authority(fleet).registry.list_enrolled()} == {*NAMES}
