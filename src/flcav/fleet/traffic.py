"""Traffic counts of the proxy by vehicle: bytes of sockets and of Flower's calls, and refusals."""

import json
from dataclasses import asdict, dataclass, field
from http import HTTPStatus
from pathlib import Path

from flcav.storage.files import write_bytes

TRAFFIC = "traffic.json"
CONTENT = ("push-object", "pull-object")  # calls that carry the apps' messages; all others are Flower's
LOOKS = ("pull-messages", "send-node-heartbeat")  # calls whose failure loses nothing, as they are repeated
MOST_REFUSALS = 200  # number of kept refusals


@dataclass
class Crossed:
    """The traffic of one vehicle, up from it and down to it [bytes]."""

    socket_up: int = 0  # on the TCP socket, TLS included
    socket_down: int = 0
    content_up: int = 0  # bodies of the calls in `CONTENT`
    content_down: int = 0
    other_up: int = 0  # bodies of Flower's other calls: polls, heartbeats, app bundles
    other_down: int = 0
    calls: int = 0
    activations: int = 0  # number of its SuperNode's activations
    release_up: int = 0  # part of `socket_up` for releases and their reports
    release_down: int = 0
    lost: int = 0  # number of calls that may have lost a message: failed by the SuperLink, or answered into the void


@dataclass
class ProxyTraffic:
    """The traffic counts of a proxy, by vehicle, and its latest refusals."""

    vehicles: dict[str, Crossed] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)

    def count(
        self, vehicle: str, call: str, up: int, down: int, socket: tuple[int, int], status: int, gone: bool = False
    ) -> None:
        """Count one call with the sizes of its bodies and the socket's bytes since the last one [bytes].

        status: of the SuperLink's response. gone: whether the connection ended before the response.
        """
        crossed = self.vehicles.setdefault(vehicle, Crossed())
        crossed.calls += 1
        crossed.socket_up += socket[0]
        crossed.socket_down += socket[1]
        crossed.activations += status == HTTPStatus.OK and call == "activate-node"
        crossed.lost += gone or (status >= HTTPStatus.INTERNAL_SERVER_ERROR and call not in LOOKS)
        if call in CONTENT:
            crossed.content_up += up
            crossed.content_down += down
        else:
            crossed.other_up += up
            crossed.other_down += down

    def count_release(self, vehicle: str, socket: tuple[int, int]) -> int:
        """Count the socket's bytes for releases; return the total down to the vehicle so far [bytes]."""
        crossed = self.vehicles.setdefault(vehicle, Crossed())
        crossed.socket_up += socket[0]
        crossed.socket_down += socket[1]
        crossed.release_up += socket[0]
        crossed.release_down += socket[1]
        return crossed.release_down

    def lose_all(self) -> None:
        """Count a loss for every vehicle, since a proxy that was killed may have been relaying a message."""
        for crossed in self.vehicles.values():
            crossed.lost += 1

    def refuse(self, who: str, why: str) -> None:
        """Note a refusal."""
        self.refused = [*self.refused, f"{who}: {why}"][-MOST_REFUSALS:]

    def save(self, folder: Path) -> None:
        """Write the counts to `folder`."""
        write_bytes(folder / TRAFFIC, json.dumps(asdict(self)).encode())


def read_traffic(folder: Path) -> ProxyTraffic:
    """Return the counts of a fleet's proxy; empty if there are none yet."""
    try:
        found = json.loads((folder / TRAFFIC).read_bytes())
    except FileNotFoundError:
        return ProxyTraffic()
    return ProxyTraffic({name: Crossed(**crossed) for name, crossed in found["vehicles"].items()}, found["refused"])
