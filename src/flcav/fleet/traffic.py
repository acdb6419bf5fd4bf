"""Traffic of the proxy by vehicle: bytes of sockets and of Flower's calls, and refusals."""

import json
from dataclasses import asdict, dataclass, field
from http import HTTPStatus
from pathlib import Path

from flcav.storage.files import write_bytes

TRAFFIC = "traffic.json"
CONTENT = ("push-object", "pull-object")  # calls that carry what an app sends; all others are Flower's own
LOOKS = ("pull-messages", "send-node-heartbeat")  # calls that lose nothing where they fail: the next one does for both
MOST_REFUSALS = 200  # that are kept


@dataclass
class Crossed:
    """Bytes of one vehicle, up from it and down to it."""

    socket_up: int = 0  # that crossed the TCP socket, TLS included
    socket_down: int = 0
    content_up: int = 0  # bodies of the calls in `CONTENT`
    content_down: int = 0
    other_up: int = 0  # bodies of Flower's other calls: polls, heartbeats, app bundles
    other_down: int = 0
    calls: int = 0
    activations: int = 0  # of its SuperNode: how often it has come in
    release_up: int = 0  # of those that crossed the socket, the ones for releases and their reports
    release_down: int = 0
    lost: int = 0  # calls with which a message may be lost: the SuperLink failed them, or their answer went nowhere


@dataclass
class ProxyTraffic:
    """Bytes by vehicle, and the latest refusals."""

    vehicles: dict[str, Crossed] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)

    def count(
        self, vehicle: str, call: str, up: int, down: int, socket: tuple[int, int], status: int, gone: bool = False
    ) -> None:
        """Count one call with the sizes of its bodies, and the bytes that crossed the socket since the last one.

        status: of the SuperLink's answer. gone: whether the connection had ended before the answer.
        """
        own = self.vehicles.setdefault(vehicle, Crossed())
        own.calls += 1
        own.socket_up += socket[0]
        own.socket_down += socket[1]
        own.activations += status == HTTPStatus.OK and call == "activate-node"
        own.lost += gone or (status >= HTTPStatus.INTERNAL_SERVER_ERROR and call not in LOOKS)
        if call in CONTENT:
            own.content_up += up
            own.content_down += down
        else:
            own.other_up += up
            own.other_down += down

    def count_release(self, vehicle: str, socket: tuple[int, int]) -> int:
        """Count bytes that crossed the socket for releases; return those down to the vehicle so far."""
        own = self.vehicles.setdefault(vehicle, Crossed())
        own.socket_up += socket[0]
        own.socket_down += socket[1]
        own.release_up += socket[0]
        own.release_down += socket[1]
        return own.release_down

    def lose_all(self) -> None:
        """Count a loss for every vehicle: a proxy that was killed may have had a message for it in its hands."""
        for own in self.vehicles.values():
            own.lost += 1

    def refuse(self, who: str, why: str) -> None:
        """Note a refusal."""
        self.refused = [*self.refused, f"{who}: {why}"][-MOST_REFUSALS:]

    def save(self, folder: Path) -> None:
        """Write it to `folder`."""
        write_bytes(folder / TRAFFIC, json.dumps(asdict(self)).encode())


def read_traffic(folder: Path) -> ProxyTraffic:
    """Return the counts of a fleet's proxy; empty if there are none yet."""
    try:
        found = json.loads((folder / TRAFFIC).read_bytes())
    except FileNotFoundError:
        return ProxyTraffic()
    return ProxyTraffic({name: Crossed(**own) for name, own in found["vehicles"].items()}, found["refused"])
