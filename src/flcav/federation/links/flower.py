"""The deployed runtime: clients are vehicles of a running fleet, and this process is the server app of its runs."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from flwr.app import Message

from flcav.config import InputError
from flcav.federation.client import ClientAgreement, client_app
from flcav.federation.links.flower_grid import POLL_S, STARTING_S, DeployedGrid
from flcav.federation.links.in_process import EmbeddedGrid, LinkGrid, keep_identity
from flcav.federation.links.metered import Account
from flcav.federation.links.vehicle_app import Assignment
from flcav.federation.state import ClientStates
from flcav.federation.trainable import Trainable
from flcav.fleet.authority import found_authority, open_registry
from flcav.fleet.fl_request import parse_request
from flcav.fleet.keys import AUTHORITY
from flcav.fleet.registry import RegisteredVehicle
from flcav.fleet.superlink import SuperLink, SuperLinkLost, locked
from flcav.fleet.supervisor import LOGS, end_with_parent
from flcav.fleet.up import READY, VEHICLES, read_ready

SERVING = "serving.lock"  # lock file in a fleet's folder, held by the federation that it serves
STARTING_VEHICLE_S = 15.0  # added per vehicle, since all may be on one busy machine [s]
LOOK_S = 0.4  # between queries of online vehicles, each of which opens a connection (some 0.1 s of CPU time) [s]
OPEN_S = 3600.0  # validity of an FL request that waits for a group [s]


class Deployment:
    """A running fleet as a runtime, found by the folder of its authority."""

    deployed: Literal[True] = True

    def __init__(self, folder: Path, first: int = 0) -> None:
        """Find the fleet of `folder`, without its first `first` vehicles. Raises `InputError` if it is not up."""
        self.folder, self.first = folder, first
        self._vehicles: dict[str, str] = {}  # vehicle by client
        self.link = SuperLink(folder, read_ready(folder).superlink)

    @contextlib.contextmanager
    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> Iterator["DeployedGrid"]:
        """Yield the grid of the vehicles to which `clients` are assigned, in the order of the vehicles' identifiers.

        A client keeps its vehicle as long as that is online. A fleet serves one federation at a time; another one waits
        until this one has ended.

        states: client states from earlier rounds. account: its budget limits the vehicles' answers. Raises `InputError`
        where there are fewer vehicles than clients, or vehicles cannot import the clients' classes, `OSError` where too
        few come online.
        """
        for name, client in clients.items():
            if type(client).__module__ == "__main__":
                kind = type(client).__name__
                raise InputError(f"{name}: vehicles cannot import {kind} from a script; put it in a module")
        with locked(self.folder / SERVING), keep_identity(), self._open(clients, agreed, states, account) as grid:
            yield grid

    @contextlib.contextmanager
    def _open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> Iterator["DeployedGrid"]:
        vehicles = self.choose_vehicles([*clients])
        # a fresh name, since vehicles answer a round once per federation
        federation = os.urandom(8).hex()
        for (name, client), vehicle in zip(clients.items(), vehicles, strict=True):
            secret = agreed.secrets.get(name)
            state = states.get(name, {})
            assignment = Assignment(
                federation, name, client, agreed.strategy, agreed.rules, secret, agreed.spent, dict(state)
            )
            if (self.folder / VEHICLES / vehicle.name).is_dir():  # other vehicles bring their client
                assignment.save(self.folder / VEHICLES / vehicle.name)
        names = {vehicle.node or 0: name for vehicle, name in zip(vehicles, clients, strict=True)}
        of_nodes = {vehicle.node or 0: vehicle for vehicle in vehicles}
        limit_s = agreed.rules.limits.train_s
        grid = DeployedGrid(self.folder, self.link, names, of_nodes, account, limit_s)
        try:
            yield grid
        except BaseException:
            grid.end(failed=True)
            raise
        grid.end()

    def choose_vehicles(self, clients: list[str]) -> list[RegisteredVehicle]:
        """Return a vehicle per client, once all are online: the client's earlier one, or another if that stays offline.

        Raises `InputError` where fewer vehicles are registered, `OSError` where fewer come online.
        """
        seconds = STARTING_S + STARTING_VEHICLE_S * len(clients)
        end = time.monotonic() + seconds
        while True:
            registry = open_registry(self.folder)
            able = [each for each in registry.list_vehicles() if each.describe_state() == "registered"][self.first :]
            registry.close()
            if len(able) < len(clients):
                counted = f"{len(able)} vehicles" + (f" beside {self.first} of other regions" if self.first else "")
                raise InputError(f"{self.folder}: {counted}, and the federation has {len(clients)} clients")
            # a client prefers its earlier vehicle, which has its state, until the timeout
            with contextlib.suppress(*SuperLinkLost):
                online = self.link.list_online()
                found = {each.name: each for each in able if each.node in online}
                kept = [vehicle for name in clients if (vehicle := self._vehicles.get(name)) is not None]
                if len(found) >= len(clients) and (found.keys() >= {*kept} or time.monotonic() > end):
                    free = iter([name for name in found if name not in kept])
                    before = {name: self._vehicles.get(name, "") for name in clients}
                    self._vehicles |= {name: old if old in found else next(free) for name, old in before.items()}
                    return [found[self._vehicles[name]] for name in clients]
            if time.monotonic() > end:
                raise OSError(f"{self.folder}: fewer than {len(clients)} vehicles are in after {seconds:g} s")
            time.sleep(LOOK_S)

    def list_requests(self, clients: Iterable[str], task: str) -> dict[str, tuple[bytes, ...]]:
        """Return the open FL requests for a task by client, latest last; clients without one are left out."""
        registry = open_registry(self.folder)
        try:
            waiting = registry.list_open_requests(time.time() - OPEN_S)
        finally:
            registry.close()
        found: dict[str, tuple[bytes, ...]] = {}
        for client in clients:
            requests = tuple(content for vehicle, content in waiting if vehicle == self._vehicles.get(client))
            found[client] = tuple(content for content in requests if parse_request(content).task == task)
        return {client: requests for client, requests in found.items() if requests}

    def answer_requests(self, requests: Iterable[bytes]) -> None:
        """Mark FL requests as answered."""
        registry = open_registry(self.folder)
        try:
            registry.answer_requests([parse_request(content).nonce for content in requests], time.time())
        finally:
            registry.close()


class RegionalDeployment:
    """A deployment of several regions, in separate fleets or in a common one."""

    deployed: Literal[True] = True

    def __init__(self, folder: Path, clients: Mapping[str, int]) -> None:
        """Find the fleets of the regions: in `folder`/REGION if it has an authority, else in `folder` itself.

        clients: number of clients by region; in a common fleet, regions take consecutive vehicles. Raises `InputError`
        where a fleet is not up.
        """
        first = 0
        self._fleets = dict[str, Deployment]()
        for region, count in clients.items():
            if (folder / region / AUTHORITY).exists():
                self._fleets[region] = Deployment(folder / region)
            else:
                self._fleets[region] = Deployment(folder, first)
                first += count

    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> contextlib.AbstractContextManager["DeployedGrid"]:
        """Return the grid of a region's `clients`, named REGION/VEHICLE, see `Deployment.open`."""
        return self.fleet_of(next(iter(clients))).open(clients, agreed, states, account)

    def fleet_of(self, client: str) -> Deployment:
        """Return the fleet of a client, named REGION/VEHICLE."""
        return self._fleets[region_of(client)]

    def beside(self, clients: Collection[str]) -> "RegionalDeployment | PartlyDeployed":
        """Return the deployment in which these `clients` of the edge server itself train in this process."""
        return PartlyDeployed(self, frozenset(clients)) if clients else self


@dataclass(frozen=True)
class PartlyDeployed:
    """A deployment plus local clients of the edge server, such as roadside units, which train in this process."""

    fleet: RegionalDeployment
    own: frozenset[str]  # names of the local clients
    deployed: Literal[True] = True

    @contextlib.contextmanager
    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> Iterator["JoinedGrid"]:
        """Yield the grid of `clients`, whose vehicles are deployed, see `Deployment.open`.

        Raises `InputError` under secure aggregation, where vehicles share masks only with certified vehicles.
        """
        if agreed.rules.secure is not None:
            local = min(self.own)
            raise InputError(
                f"secure: {local} trains in the server's process, and vehicles share masks with vehicles alone"
            )
        here = {name: client for name, client in clients.items() if name in self.own}
        there = {name: client for name, client in clients.items() if name not in self.own}
        app = client_app(here, agreed.strategy, agreed.rules, agreed.secrets, agreed.spent)
        with self.fleet.open(there, agreed, states, account) as far:
            yield JoinedGrid(far, EmbeddedGrid(app, [*here], states), [*clients])


class JoinedGrid(LinkGrid):
    """A grid of deployed nodes and of nodes in this process."""

    def __init__(self, far: "DeployedGrid", near: EmbeddedGrid, clients: Sequence[str]) -> None:
        """Join two grids, whose nodes are `clients`, in their order."""
        self._grid, self._far, self._near, self.follow = far, far, near, far.follow
        nodes = {name: node for grid in (far, near) for node, name in grid.names.items()}
        self.names = {nodes[name]: name for name in clients}

    def read_states(self, keys: Iterable[str]) -> ClientStates:
        """Return the client states with these keys, by client and key."""
        wanted = tuple(keys)
        found = self._far.read_states(wanted) | self._near.read_states(wanted)
        return {name: found[name] for name in self.names.values() if name in found}

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies in the order of the messages; local nodes answer after the deployed ones before them.

        timeout: of the deployed nodes [s].
        """
        asked = [*messages]
        far = [message for message in asked if message.metadata.dst_node_id not in self._near.names]
        answers = iter(self._grid.send_and_receive(far, timeout=timeout))
        for message in asked:
            if message.metadata.dst_node_id in self._near.names:
                yield from self._near.send_and_receive([message])
            elif (answer := next(answers, None)) is not None:
                yield answer


def region_of(client: str) -> str:
    """Return the region of a client named REGION/VEHICLE."""
    return client.partition("/")[0]


@contextlib.contextmanager
def start_fleet(vehicles: int) -> Iterator[Deployment]:
    """Yield a temporary fleet of `vehicles` vehicles on this machine, which ends with the context."""
    with tempfile.TemporaryDirectory(prefix="flcav-fleet-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        found_authority(folder)
        with fleet_up(folder, vehicles):
            yield Deployment(folder)


@contextlib.contextmanager
def fleet_up(folder: Path, vehicles: int, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Yield the process of `flcav fleet up` in a folder, once the fleet is up; it ends with the context."""
    (folder / LOGS).mkdir(exist_ok=True)
    command = [sys.executable, "-m", "flcav", "fleet", "up", str(folder), "--vehicles", str(vehicles), *options]
    with (folder / LOGS / "up.log").open("ab") as log:
        ending = partial(end_with_parent, os.getpid(), signal.SIGTERM)  # however this process ends
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, preexec_fn=ending
        )
    try:
        end = time.monotonic() + STARTING_S
        while not (folder / READY).exists():
            if process.poll() is not None or time.monotonic() > end:
                reason = (folder / LOGS / "up.log").read_text(errors="replace").strip().rpartition("\n")[2]
                raise OSError(f"{folder}: the fleet did not come up: {reason}")
            time.sleep(POLL_S)
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
