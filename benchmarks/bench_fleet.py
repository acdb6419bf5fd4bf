"""What a deployed fleet costs: its registry at 10,000 vehicles, its proxy and forwarder, and a round taken apart.

The parts of a round are measured one by one; the rest of it are Flower's waits: a node looks for messages every 3 s
while it has none, and for the app's answer every half second.
"""

import base64
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import httpx
import numpy as np
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from flwr.app import RecordDict
from flwr.common.serde import recorddict_from_proto, recorddict_to_proto
from flwr.proto.fleet_pb2 import PullMessagesRequest
from flwr.proto.message_pb2 import PushObjectRequest
from flwr.proto.node_pb2 import Node

from flcav.federation.links.flower import Deployment, start_fleet
from flcav.federation.loop import Schedule, federate
from flcav.federation.trainable import LocalUpdate
from flcav.federation.wire import to_array_record
from flcav.fleet.authority import found_authority, open_registry
from flcav.fleet.forwarder import vehicle_tls
from flcav.fleet.keys import AUTHORITY, KEY, LOOPBACK, load_key, request_certificate
from flcav.fleet.supervisor import read_processes
from flcav.fleet.up import VEHICLES
from flcav.fleet.vehicle import load_settings

REGISTERED, CALLS, ROUNDS = 10_000, 30, 6
MEGABYTES = 4.0  # of the model


@dataclass(frozen=True)
class Still:
    """A client that does nothing, so that a round is all overhead."""

    def train(self, weights, *, steps, learning_rate, seed):
        """Return the weights as they came."""
        return LocalUpdate(dict(weights), 1, 0.0)


def seconds(do: Callable[[], object], times: int) -> float:
    """Return the median wall time of a call [s]."""
    taken = []
    for _ in range(times):
        begun = time.perf_counter()
        do()
        taken.append(time.perf_counter() - begun)
    return statistics.median(taken)


def measure_registry(folder: Path) -> None:
    """Print what a register, a revoke and a list take as the registry grows to `REGISTERED` vehicles."""
    authority = found_authority(folder / "fleet")
    requests = [request_certificate(folder / f"{number}", f"v{number:05d}") for number in range(50)]
    from flcav.fleet.registry import RegisteredVehicle

    end = int(time.time()) + 10**6
    with authority.registry._change() as cursor:
        for number in range(REGISTERED - 50):
            own = RegisteredVehicle(f"w{number:05d}", f"{number:064x}", number.to_bytes(8, "big"), 0, end)
            authority.registry._insert(cursor, own, "register")
    waiting = iter(requests)
    print(f"register one of {REGISTERED}: {1e3 * seconds(lambda: authority.register(next(waiting)), 50):.1f} ms")
    names = iter([f"v{number:05d}" for number in range(50)])
    print(f"revoke one: {1e3 * seconds(lambda: authority.registry.revoke(next(names)), 50):.1f} ms")
    print(f"find one by its certificate: {1e3 * seconds(lambda: authority.registry.find('0' * 64), 50):.2f} ms")
    print(f"list all: {1e3 * seconds(authority.registry.list_vehicles, 5):.0f} ms")


def cpu_seconds(folder: Path) -> dict[str, float]:
    """Return the CPU time that each process of a fleet, and its children that have ended, have taken [s]."""
    found = {}
    for name, pid in read_processes(folder).items():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        found[name] = sum(int(each) for each in fields[11:15]) / os.sysconf("SC_CLK_TCK")
    return found


def headers(key: ec.EllipticCurvePrivateKey) -> dict[str, str]:
    """Return Flower's headers of a node."""
    pem = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    stamp = datetime.now(UTC).isoformat()
    signed = base64.b64encode(key.sign(stamp.encode(), ec.ECDSA(hashes.SHA256()))).decode()
    kind = {"content-type": "application/protobuf", "accept": "application/protobuf"}
    return {
        **kind,
        "flwr-public-key": base64.b64encode(pem).decode(),
        "flwr-signature": signed,
        "flwr-timestamp": stamp,
    }


def measure_relays(deployment: Deployment) -> tuple[float, float]:
    """Print and return what forwarder and proxy add to a small call, and to one with a piece of 4 MB [s]."""
    own = deployment.folder / VEHICLES / "vehicle-001"
    registry = open_registry(deployment.folder)
    node, key = Node(node_id=registry.list_vehicles()[0].node or 0), load_key(own / KEY)
    small = PullMessagesRequest(node=node).SerializeToString()
    large = PushObjectRequest(
        node=node, run_id=1, object_id="0" * 64, object_content=bytes(4_000_000)
    ).SerializeToString()
    ways = {
        "direct": (f"https://{deployment.link.address}", str(deployment.folder / AUTHORITY)),
        "through both": (f"https://127.0.0.1:{load_settings(own).forwarder_port}", str(own / LOOPBACK)),
    }
    found: dict[str, dict[str, float]] = {}
    for way, (address, trusted) in ways.items():
        with httpx.Client(base_url=address, verify=trusted, trust_env=False, timeout=60) as client:
            for name, path, body in (("small", "pull-messages", small), ("4 MB", "push-object", large)):
                call = lambda path=path, body=body: client.post(f"/v1/fleet/{path}", content=body, headers=headers(key))  # noqa: E731
                call()
                found.setdefault(name, {})[way] = seconds(call, CALLS)
    for name, took in found.items():
        print(f"a call, {name}: " + ", ".join(f"{way} {1e3 * each:.1f} ms" for way, each in took.items()))
    handshake = lambda: httpx.post(  # noqa: E731
        f"https://{load_settings(own).server}/", verify=vehicle_tls(own), trust_env=False
    )
    print(f"a new connection to the proxy, and a refused call: {1e3 * seconds(handshake, 10):.0f} ms")
    extra = {name: took["through both"] - took["direct"] for name, took in found.items()}
    return extra["small"], extra["4 MB"]


def main() -> None:
    """Print all figures."""
    import bench_fleet  # so that vehicles can import its client, too

    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]).rstrip(
        ":"
    )
    with tempfile.TemporaryDirectory() as folder:
        measure_registry(Path(folder))
    weights = {"w": np.random.default_rng(0).normal(size=int(MEGABYTES * 1e6 / 4)).astype(np.float32)}
    record = RecordDict({"arrays": to_array_record(weights)})
    turn = lambda: recorddict_from_proto(recorddict_to_proto(record))  # noqa: E731
    print(f"serialise {MEGABYTES:g} MB and read it: {1e3 * seconds(turn, 5):.0f} ms")
    start = [sys.executable, "-c", "import flcav.federation.links.vehicle_app, flwr.supernode.runtime.run_clientapp"]
    took = seconds(lambda: subprocess.run(start, check=True), 3)
    print(f"a process of Flower's for a message, without torch: {took:.1f} s")
    with start_fleet(1) as deployment:
        small, large = measure_relays(deployment)
        ended: list[float] = []
        schedule = Schedule(ROUNDS, 1, 0.1, 0.1, 0)
        about = {"runtime": deployment, "on_round": lambda *_: ended.append(time.perf_counter())}
        before = cpu_seconds(deployment.folder)
        federate({"cav0": bench_fleet.Still()}, weights, schedule, **about)
        spent = {name: each - before[name] for name, each in cpu_seconds(deployment.folder).items()}
        took = statistics.median(np.diff(ended))
    print(f"a round of one vehicle that does nothing with {MEGABYTES:g} MB: {took:.1f} s")
    print(f"forwarder and proxy: {100 * (12 * small + 2 * large) / took:.1f} % of it (12 small calls, 2 of the model)")
    print("CPU time a round: " + ", ".join(f"{name} {each / ROUNDS:.2f} s" for name, each in spent.items()))
    ours = spent["proxy"] + spent["vehicle-001-forwarder"]
    print(f"forwarder and proxy: {100 * ours / (sum(spent.values()) - ours):.0f} % of the other processes' CPU time")


if __name__ == "__main__":
    main()
