"""Control of Flower's SuperLink: enrolment of nodes, start of runs, and this process as the server app of a run.

It uses private parts of Flower (pinned to 1.42): the clients of its control and runtime interfaces, and its table of
app bundles; so do `vehicle`, for its node and executor, and the federation's `links.vehicle_app` and
`links.in_process`, for messages. The control interface needs no credential, so that the SuperLink listens on the
loopback of the operator's host only; the executor's secret is in a file that only its owner can read.
"""

import base64
import contextlib
import fcntl
import hashlib
import json
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519
from flwr.cli.build import build_fab_from_files
from flwr.common.constant import SubStatus
from flwr.common.serde import run_from_proto
from flwr.proto.control_pb2 import ListNodesRequest, RegisterNodeRequest, StartRunRequest, UnregisterNodeRequest
from flwr.proto.fab_pb2 import Fab
from flwr.proto.runtime_pb2 import (
    AcquireTaskRequest,
    PullTaskInputRequest,
    PushTaskOutputRequest,
    SendTaskHeartbeatRequest,
)
from flwr.supercore.constant import TaskType
from flwr.supercore.control import ControlHttpClient
from flwr.supercore.interceptors import RuntimeVersionHttpInterceptor, SuperExecAuthHttpInterceptor
from flwr.supercore.runtime import RuntimeHttpClient
from flwr.supercore.task_identity import TaskIdentity
from flwr.superlink.grid import HttpGrid

from flcav.config import InputError
from flcav.fleet.keys import AUTHORITY, public_pem, write_private
from flcav.fleet.registry import VehicleRegistry
from flcav.storage.files import write_bytes

SECRET, DATABASE = "executor.secret", "superlink.sqlite"  # in the fleet's folder
ACQUIRE = frozenset({"/flwr.proto.Runtime/AcquireTask"})
HEARTBEAT_S = 20.0  # [s]; Flower ends a run whose server has been silent for a minute
ONLINE = "online"
SuperLinkLost = (httpx.HTTPError, RuntimeError, OSError)  # raised by its clients where it cannot be reached


@dataclass(frozen=True)
class SuperLink:
    """The SuperLink of a fleet, at an address of this host."""

    folder: Path
    address: str  # host:port

    def is_up(self) -> bool:
        """Return whether the SuperLink answers."""
        try:
            response = httpx.get(
                f"https://{self.address}/health", verify=str(self.folder / AUTHORITY), timeout=2.0, trust_env=False
            )
        except httpx.HTTPError:
            return False
        return response.status_code == httpx.codes.OK

    def wait(self, seconds: float) -> None:
        """Wait until the SuperLink answers; raises `OSError` after a timeout of `seconds` [s]."""
        end = time.monotonic() + seconds
        while not self.is_up():
            if time.monotonic() > end:
                raise OSError(f"the SuperLink at {self.address} does not answer after {seconds:g} s")
            time.sleep(0.1)

    @contextlib.contextmanager
    def _control(self) -> Iterator[ControlHttpClient]:
        certificate = (self.folder / AUTHORITY).read_bytes()
        version = [RuntimeVersionHttpInterceptor(component_name="flwr CLI")]
        with ControlHttpClient.from_server_address(self.address, False, certificate, version) as client:
            yield client

    def enrol(self, registry: VehicleRegistry) -> None:
        """Make the SuperLink's nodes equal to the registry's vehicles in force: enrol new ones, remove others."""
        wanted = {
            vehicle.fingerprint: vehicle
            for vehicle in registry.list_vehicles()
            if vehicle.describe_state() == "registered"
        }
        with self._control() as control:
            there = {node.node_id for node in control.ListNodes(ListNodesRequest()).nodes_info}
            for vehicle in registry.list_enrolled():
                if vehicle.fingerprint not in wanted:
                    if vehicle.node in there:
                        control.UnregisterNode(UnregisterNodeRequest(node_id=vehicle.node))
                    registry.set_node(vehicle.fingerprint, None)
            for vehicle in wanted.values():
                if vehicle.node not in there:
                    answer = control.RegisterNode(
                        RegisterNodeRequest(public_key=public_pem(vehicle.public_key), name=vehicle.name)
                    )
                    registry.set_node(vehicle.fingerprint, answer.node_id)

    def list_online(self) -> set[int]:
        """Return the ids of the nodes that are online."""
        with self._control() as control:
            return {node.node_id for node in control.ListNodes(ListNodesRequest()).nodes_info if node.status == ONLINE}

    def begin(self, bundle: bytes | None = None, signature: dict[str, str] | None = None) -> "ServerRun":
        """Start a run of a bundle (None: the vehicles' app, signed by the publisher); return its server side."""
        bundle = build_bundle() if bundle is None else bundle
        signature = sign_bundle(self.folder, bundle) if signature is None else signature
        certificate = (self.folder / AUTHORITY).read_bytes()
        interceptors = [
            RuntimeVersionHttpInterceptor(component_name="SuperExec"),
            SuperExecAuthHttpInterceptor(master_secret=(self.folder / SECRET).read_bytes(), protected_methods=ACQUIRE),
        ]
        with (
            locked(self.folder / f"{SECRET}.lock"),  # so that the pending task is that of this run
            self._control() as control,
            RuntimeHttpClient.from_server_address(self.address, False, certificate, interceptors) as runtime,
        ):
            # this process takes the task of the server app, in place of Flower's executor
            number = control.StartRun(StartRunRequest(fab=Fab(content=bundle))).run_id
            self._attach(bundle, signature)
            while True:
                task = runtime.AcquireTask(AcquireTaskRequest(supported_task_types=[TaskType.SERVER_APP]))
                if task.token and task.task.run_id == number:
                    return ServerRun(self.address, certificate, task.token)
                if task.token:  # of a run whose command died before it had its task
                    ServerRun(self.address, certificate, task.token).end(failed=True)
                else:
                    time.sleep(0.05)

    def _attach(self, bundle: bytes, signature: dict[str, str]) -> None:
        """Store a bundle's signature in Flower's database, as Flower does for apps of its hub."""
        with contextlib.closing(sqlite3.connect(self.folder / DATABASE, timeout=10.0)) as connection, connection:
            values = json.dumps(signature), hashlib.sha256(bundle).hexdigest()
            if connection.execute("UPDATE fab SET verifications = ? WHERE fab_hash = ?", values).rowcount != 1:
                raise OSError(f"{self.folder / DATABASE}: is not the database of the SuperLink at {self.address}")


class ServerRun:
    """A run in progress, with this process as its server app."""

    def __init__(self, address: str, certificate: bytes, token: str) -> None:
        self.grid: Any = HttpGrid(address, False, certificate, token=token)
        self.grid._retry_invoker = None  # Flower's ends this process where the SuperLink has lost the run
        self._client = self.grid._runtime_client
        given = self._client.PullTaskInput(PullTaskInputRequest())
        self._identity = given.task_id, given.run.run_id, given.context.node_id
        self._context = given.context
        self.id = given.run.run_id
        self.grid.set_run(run_from_proto(given.run))
        self._ended = threading.Event()
        threading.Thread(target=self._beat, daemon=True).start()

    def identify(self) -> None:
        """Set the sender of messages created from now on to this run's server."""
        TaskIdentity.task_id, TaskIdentity.run_id, TaskIdentity.node_id = self._identity

    def end(self, failed: bool = False) -> None:
        """End the run; does nothing where the SuperLink cannot be reached."""
        self._ended.set()
        status = SubStatus.FAILED if failed else SubStatus.COMPLETED
        with contextlib.suppress(*SuperLinkLost):
            self._client.PushTaskOutput(PushTaskOutputRequest(context=self._context, sub_status=status, details=""))
        self.grid.close()

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            with contextlib.suppress(*SuperLinkLost):
                self._client.SendTaskHeartbeat(SendTaskHeartbeatRequest())


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file; waits while another process holds it."""
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


PUBLISHER_KEY, TRUSTED = "publisher.key", "trusted.yaml"
PROJECT = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "flcav-vehicle"
version = "1.0.0"
license = "MIT"
dependencies = []
[tool.flwr.app]
publisher = "flcav"
[tool.flwr.app.components]
serverapp = "flcav_vehicle.server:app"
clientapp = "flcav_vehicle.client:app"
[tool.flwr.app.config]
"""
CLIENT = "from flcav.federation.links.vehicle_app import make_vehicle_app\n\napp = make_vehicle_app()\n"
SERVER = '''"""The server of a federation is the process that asks for it: flcav federate --runtime flower."""
from flwr.serverapp import ServerApp

app = ServerApp()
'''


def build_bundle(client: str = CLIENT) -> bytes:
    """Return the bundle (FAB) of the vehicles' app; `client` is the source of its client module."""
    files: dict[str, bytes | Path] = {
        "pyproject.toml": PROJECT.encode(),
        "flcav_vehicle/__init__.py": b"",
        "flcav_vehicle/client.py": client.encode(),
        "flcav_vehicle/server.py": SERVER.encode(),
    }
    return build_fab_from_files(files)[0]


def make_publisher(folder: Path) -> None:
    """Make the publisher's key in `folder`, and the file of keys that vehicles trust."""
    key = ed25519.Ed25519PrivateKey.generate()
    openssh = serialization.PrivateFormat.OpenSSH
    write_private(
        folder / PUBLISHER_KEY, key.private_bytes(serialization.Encoding.PEM, openssh, serialization.NoEncryption())
    )
    line = key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH).decode()
    write_bytes(folder / TRUSTED, f"{_name_key(key.public_key())}: '{line}'\n".encode())


def sign_bundle(folder: Path, bundle: bytes) -> dict[str, str]:
    """Return the publisher's signature of a bundle in Flower's format, by the name of the key."""
    key = serialization.load_ssh_private_key((folder / PUBLISHER_KEY).read_bytes(), None)
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise InputError(f"{folder / PUBLISHER_KEY}: an Ed25519 key is wanted")
    now = int(time.time())
    signature = key.sign(now.to_bytes(8, "big") + hashlib.sha256(bundle).digest())
    stored = json.dumps({"signed_at": now, "signature": base64.urlsafe_b64encode(signature).decode().rstrip("=")})
    return {"valid_license": "Valid", _name_key(key.public_key()): stored}


def _name_key(key: ed25519.Ed25519PublicKey) -> str:
    raw = key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return f"fpk_{hashlib.sha256(raw).hexdigest()[:32]}"
