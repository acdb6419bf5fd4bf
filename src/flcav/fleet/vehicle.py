"""A vehicle's processes: its forwarder, Flower's SuperNode, and an executor that forks its app for every message.

Flower would start a process per message, which imports everything again; the executor imports once and forks. Flower's
SuperNode waits without end for the answer of an app that was ended or could not hand it over, and starts an app for a
message whose run ended before it was received whole, which waits without end for the rest: the executor then ends the
app, and lets the SuperNode be restarted. A vehicle is installed with its certificate, its trusted keys, and the address
of the fleet.
"""

import contextlib
import importlib
import json
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from flcav.config import InputError
from flcav.fleet.keys import FLOWER_KEY, LOOPBACK, LOOPBACK_KEY, make_loopback, take_certificate, write_private
from flcav.fleet.superlink import ACQUIRE, SECRET, TRUSTED
from flcav.fleet.supervisor import end_with_parent
from flcav.plugins import PLACE
from flcav.storage.files import write_bytes, write_json

SETTINGS, FOLDER = "vehicle.json", "FLCAV_VEHICLE"  # file name; environment variable of the app
NODE_PID, POLLED = "supernode.pid", "polled"  # files: the SuperNode's process id; touched when it asks for a message
POLL_S = 0.1  # interval of polling for a message [s]
EXIT_S = 10.0  # after the SuperNode asks for the next message, before the app of the last is ended [s]


@dataclass(frozen=True)
class VehicleSettings:
    """The settings of a vehicle: addresses, and its client."""

    server: str  # host:port of the fleet's proxy
    forwarder_port: int  # on the vehicle's loopback
    node_port: int
    client: str = ""  # module:NAME of its `Assignment`; "": the one in its folder

    def save(self, folder: Path) -> None:
        """Write the settings to a vehicle's folder, with the secrets by which its processes authenticate."""
        write_json(folder / SETTINGS, asdict(self))
        if not (folder / SECRET).exists():
            write_private(folder / SECRET, os.urandom(32).hex().encode())
        if not (folder / LOOPBACK_KEY).exists():
            make_loopback(folder)


def load_settings(folder: Path) -> VehicleSettings:
    """Return the settings in a vehicle's folder; raises `InputError` if there are none."""
    try:
        return VehicleSettings(**json.loads((folder / SETTINGS).read_bytes()))
    except FileNotFoundError:
        raise InputError(f"{folder}: is no vehicle's folder, without {SETTINGS}") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{folder / SETTINGS}: {error}") from None


Prepare = Callable[[Path], None]  # called with the vehicle's folder before every message, to import its modules


def vehicle_processes(
    folder: Path, prepare: Prepare, others: Mapping[str, Callable[[Path], None]] = {}
) -> dict[str, Callable[[], None]]:
    """Return the functions of a vehicle's processes by name; those of `others` are called with its folder."""
    settings = load_settings(folder)

    def forward() -> None:
        from flcav.fleet.forwarder import run_forwarder

        run_forwarder(folder, settings.forwarder_port, settings.server, folder / POLLED)

    return {
        "forwarder": forward,
        "supernode": lambda: run_supernode(folder, settings),
        "executor": lambda: run_executor(folder, f"127.0.0.1:{settings.node_port}", prepare),
        **{name: partial(do, folder) for name, do in others.items()},
    }


def run_supernode(folder: Path, settings: VehicleSettings) -> None:
    """Run `flower-supernode` in this process until it ends."""
    from flwr.supernode.cli.flower_supernode import flower_supernode

    write_bytes(folder / NODE_PID, str(os.getpid()).encode())
    sys.argv = [
        "flower-supernode",
        *("--superlink", f"127.0.0.1:{settings.forwarder_port}"),
        *("--root-certificates", str(folder / LOOPBACK)),
        *("--auth-supernode-private-key", str(folder / FLOWER_KEY)),
        *("--trusted-entities", str(folder / TRUSTED)),
        *("--isolation", "process", "--superexec-auth-secret-file", str(folder / SECRET)),
        *("--host", "127.0.0.1", "--port", str(settings.node_port)),
    ]
    flower_supernode()


def run_executor(folder: Path, node: str, prepare: Prepare) -> None:
    """Run the app for the messages of the SuperNode at `node`, one at a time, in forks of this process."""
    import httpx
    from flwr.proto.runtime_pb2 import AcquireTaskRequest
    from flwr.supercore.constant import TaskType
    from flwr.supercore.interceptors import RuntimeVersionHttpInterceptor, SuperExecAuthHttpInterceptor
    from flwr.supercore.runtime import RuntimeHttpClient

    os.environ[FOLDER] = str(folder)
    parent = os.getppid()
    secret = SuperExecAuthHttpInterceptor(master_secret=(folder / SECRET).read_bytes(), protected_methods=ACQUIRE)
    version = RuntimeVersionHttpInterceptor(component_name="SuperExec")
    with RuntimeHttpClient.from_server_address(node, True, None, [version, secret]) as client:
        while os.getppid() == parent:
            try:
                task = client.AcquireTask(AcquireTaskRequest(supported_task_types=[TaskType.CLIENT_APP]))
            except httpx.HTTPError:  # the SuperNode is starting
                time.sleep(POLL_S)
                continue
            if task.token:
                prepare(folder)
                pid = (folder / NODE_PID).read_bytes()
                if not _run_app(node, task.token, folder / POLLED) and pid == (folder / NODE_PID).read_bytes():
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(int(pid), signal.SIGTERM)  # its supervisor restarts it
            else:
                time.sleep(POLL_S)


def _run_app(node: str, token: str, polled: Path) -> bool:
    """Run the app for one message; return whether it handed over an answer, and ended.

    It is ended soon after the SuperNode asks for another message, which shows that it does not wait for this answer.
    """

    def read_time() -> int:
        return polled.stat().st_mtime_ns if polled.exists() else 0

    before, last = read_time(), float("inf")
    child = _fork(node, token)
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if last == float("inf") and read_time() != before:
            last = time.monotonic() + EXIT_S
        if time.monotonic() > last:
            os.kill(child, signal.SIGKILL)
        time.sleep(POLL_S)
    return ended[1] == 0


def _fork(node: str, token: str) -> int:
    """Fork a process that runs the app for one message, and ends with 0 if an answer was handed over; return its id."""
    parent, child = os.getpid(), os.fork()
    if child:
        return child
    answered = False
    try:
        end_with_parent(parent, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        app = importlib.import_module("flwr.supernode.runtime.run_clientapp")
        push = app.push_message

        def push_message(*what: Any) -> None:
            nonlocal answered
            push(*what)
            answered = True

        vars(app)["push_message"] = push_message
        app.run_clientapp(node, token, True)
    finally:
        os._exit(0 if answered else 1)


def check_port(host: str, port: int) -> int:
    """Return a port that is free to listen on, for 0 any; raises `InputError` if `port` is in use."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as door:
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            door.bind((host, port))
        except (OSError, OverflowError) as error:
            raise InputError(f"{host}:{port}: cannot be listened on ({getattr(error, 'strerror', error)})") from None
        return door.getsockname()[1]


def install_vehicle(
    folder: Path, certificate: Path, authority: Path, trusted: Path, server: str, client: str = ""
) -> None:
    """Install the authority's files in a vehicle's folder; raises `InputError` for a file of another kind.

    server: host:port of the proxy. client: module:NAME of the vehicle's `Assignment` (`links.vehicle_app` of the
    federation); "": that in its folder.
    """
    if client and not PLACE.fullmatch(client):
        raise InputError(f"--client {client[:80]}: a module, a colon and a name in it are wanted")
    if not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[A-Za-z0-9.-]+):[0-9]{1,5}", server):
        raise InputError(f"--server {server[:80]}: HOST:PORT is wanted")
    keys = trusted.read_bytes()
    try:
        parsed = yaml.safe_load(keys)
    except (yaml.YAMLError, ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict) or not parsed:
        raise InputError(f"{trusted}: names no key that apps are signed by")
    take_certificate(folder, certificate.read_bytes(), authority.read_bytes())
    write_bytes(folder / TRUSTED, keys)
    VehicleSettings(server, check_port("127.0.0.1", 0), check_port("127.0.0.1", 0), client).save(folder)
