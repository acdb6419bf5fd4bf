"""The status of a fleet: registered and connected vehicles, rounds of its federation, bytes and budgets, refusals."""

import contextlib
import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from flcav.config import InputError
from flcav.fleet.authority import open_registry
from flcav.fleet.fl_request import FLRequest, parse_request
from flcav.fleet.releases import ReleaseReport, read_reports
from flcav.fleet.superlink import SuperLink, SuperLinkLost
from flcav.fleet.supervisor import read_processes
from flcav.fleet.traffic import Crossed, read_traffic
from flcav.fleet.up import read_ready
from flcav.interface.wording import make_printable, plural
from flcav.storage.files import write_bytes
from flcav.storage.records import LEFT_OUT, WHERE_TRUE, Record

SHOWN = 20  # number of latest requests and refusals
LEAST_ROOM = 1_000_000  # free bytes on the fleet's disk below which the status warns
PROGRESS = "federation.json"  # in the fleet's folder, written by the server of a federation


def _print_all(words: Mapping[str, str]) -> dict[str, str]:
    return {make_printable(name): make_printable(why) for name, why in words.items()}


@dataclass(frozen=True)
class RoundProgress(Record):
    """The progress report of one completed round."""

    round: int
    time: float  # when it ended [s since 1970]
    clients: int  # number whose updates were combined; 0 where the draw of clients is secret
    failed: Mapping[str, str] = field(default_factory=dict)  # reason of failure, by client
    loss: float | None = None
    epsilon: float | None = None  # over all rounds so far
    empty: Annotated[bool, WHERE_TRUE] = False  # no update, since clients had no samples


@dataclass(frozen=True)
class FederationProgress(Record):
    """The progress of a fleet's current or last federation."""

    stage: str
    task: str
    link: str
    used_mb: float  # of the uplink, by the ledger [MB]
    left_mb: float  # of the uplink's budget [MB]
    rounds: tuple[RoundProgress, ...] = ()
    waits: Mapping[str, str] = field(default_factory=dict)  # reason of waiting, by client
    gone: Mapping[str, str] = field(default_factory=dict)  # reason of exclusion from the federation, by client

    def save(self, folder: Path) -> None:
        """Write the progress to the fleet's folder."""
        write_bytes(folder / PROGRESS, json.dumps(self.as_json()).encode())

    def describe(self) -> str:
        """Return the progress in a sentence."""
        bytes_ = f"{self.used_mb:.3g} MB on the {self.link} uplink"
        bytes_ += f", {self.left_mb:.3g} MB left" if self.left_mb < 1e9 else ""
        text = f"{self.stage} of {self.task}: {plural(len(self.rounds), 'round')}, {bytes_}"
        empty = sum(each.empty for each in self.rounds)
        text += f", {plural(empty, 'empty round')}" if empty else ""
        failed = sum(len(each.failed) for each in self.rounds)
        text += f", {plural(failed, 'failure')}" if failed else ""
        if self.rounds and self.rounds[-1].epsilon is not None:
            text += f", epsilon {self.rounds[-1].epsilon:.3g}"
        late = {} if not self.rounds else self.rounds[-1].failed
        last = [f"round {self.rounds[-1].round} without {name}: {late[name]}" for name in late if name not in self.gone]
        waits = [f"waits for {name}: {why}" for name, why in self.waits.items()]
        return "; ".join([text, *last, *(f"without {name}: {why}" for name, why in self.gone.items()), *waits])

    def in_plain_words(self) -> "FederationProgress":
        """Return the progress with printable texts from vehicles."""
        rounds = tuple(replace(each, failed=_print_all(each.failed)) for each in self.rounds)
        return replace(self, rounds=rounds, waits=_print_all(self.waits), gone=_print_all(self.gone))


@dataclass(frozen=True)
class VehicleStatus(Record):
    """The status of a vehicle: certificate, node, and bytes on the proxy's sockets."""

    name: str
    state: str  # of the certificate
    expires: int  # [s since 1970]
    online: bool
    socket_up: int  # [bytes], TLS included
    socket_down: int
    content_up: int  # [bytes] of its app's messages, in Flower's serialisation
    content_down: int
    release: Annotated[ReleaseReport | None, LEFT_OUT] = None  # its latest report on its driving network


@dataclass(frozen=True)
class Asked(Record):
    """An accepted FL request."""

    vehicle: str
    request: FLRequest
    answered: bool = False  # by a group

    def describe(self) -> str:
        """Return the request in a sentence."""
        request = self.request
        at = f"({request.x:.0f}, {request.y:.0f}) m"
        seen = f"loss {request.loss:.3g} on {plural(request.frames, 'frame')} held back, at {at}"
        text = f"{self.vehicle} asks for federated learning of {request.task}: {seen}"
        return f"{text}; a group was formed" if self.answered else text


@dataclass(frozen=True)
class FleetStatus(Record):
    """The status of a fleet."""

    proxy: str | None  # host:port; None: the fleet is not up
    processes: Mapping[str, int]  # ids of the processes on this machine, by name
    vehicles: tuple[VehicleStatus, ...]
    requests: tuple[Asked, ...]  # latest last
    refused: tuple[str, ...]  # caller and reason; latest last
    free: int  # on the disk of the fleet's folder [bytes]
    federation: FederationProgress | None
    time: float  # [s since 1970]


def read_fleet_status(folder: Path) -> FleetStatus:
    """Return the status of the fleet in `folder`; raises `InputError` if there is none."""
    registry = open_registry(folder)
    try:
        registered = registry.list_vehicles()
        asked, answered = registry.list_requests(SHOWN), registry.list_answered()
    finally:
        registry.close()
    traffic = read_traffic(folder)
    online = set[int]()
    try:
        ready = read_ready(folder)
    except InputError:
        ready = None
    if ready is not None:
        with contextlib.suppress(*SuperLinkLost):
            online = SuperLink(folder, ready.superlink).list_online()
    vehicles = []
    reports = read_reports(folder)
    for vehicle_ in registered:
        crossed = traffic.vehicles.get(vehicle_.name, Crossed())
        counted = crossed.socket_up, crossed.socket_down, crossed.content_up, crossed.content_down
        release = reports[vehicle_.name].report if vehicle_.name in reports else None
        certified = vehicle_.name, vehicle_.describe_state(), vehicle_.expires, vehicle_.node in online
        vehicles.append(VehicleStatus(*certified, *counted, release))
    try:
        federation = FederationProgress.from_json(json.loads((folder / PROGRESS).read_bytes()), str(folder / PROGRESS))
        federation = federation.in_plain_words()
    except FileNotFoundError:
        federation = None
    proxy = None if ready is None else ready.proxy
    made = [(vehicle, parse_request(content)) for vehicle, _, content in asked]
    requests = tuple(Asked(vehicle, vehicle_, vehicle_.nonce in answered) for vehicle, vehicle_ in made)
    refused = tuple(map(make_printable, traffic.refused[-SHOWN:]))
    free = shutil.disk_usage(folder).free
    rest = refused, free, federation, time.time()
    return FleetStatus(proxy, read_processes(folder), tuple(vehicles), requests, *rest)
