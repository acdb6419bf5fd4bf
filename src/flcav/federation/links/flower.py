"""The deployed runtime: clients are vehicles of a fleet that is up, and this process is the server app of its runs."""

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

SERVING = "serving.lock"  # in a fleet's folder: held by the federation that it serves
STARTING_VEHICLE_S = 15.0  # more for each vehicle, which may all be on a busy machine
LOOK_S = 0.4  # between looks who is in: each is a connection of its own, of some 0.1 s of CPU time
OPEN_S = 3600.0  # that an FL request waits for a group


class Deployment:
    """A fleet that is up, in the folder of its authority."""

    deployed: Literal[True] = True

    def __init__(self, folder: Path, first: int = 0) -> None:
        """Find the fleet of `folder`; `first` vehicles are another region's. Raises `InputError` where it is not up."""
        self.folder, self.first = folder, first
        self._vehicles: dict[str, str] = {}  # by client, its vehicle
        self.link = SuperLink(folder, read_ready(folder).superlink)

    @contextlib.contextmanager
    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> Iterator["DeployedGrid"]:
        """Yield the grid of vehicles that `clients` are assigned to, in the order of the vehicles' identifiers.

        A client keeps its vehicle as long as that comes in. A fleet serves one federation at a time: another one waits
        until this one has ended.

        states: what clients have kept from earlier rounds. account: by which vehicles are granted bytes. Raises
        `InputError` where there are fewer vehicles than clients, or they cannot import these, `OSError` where they do
        not come in.
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
        federation = os.urandom(8).hex()
        for (name, client), vehicle in zip(clients.items(), vehicles, strict=True):
            secret, state = agreed.secrets.get(name), states.get(name, {})
            own = Assignment(federation, name, client, agreed.strategy, agreed.rules, secret, agreed.spent, dict(state))
            if (self.folder / VEHICLES / vehicle.name).is_dir():  # others have their own client
                own.save(self.folder / VEHICLES / vehicle.name)
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
        """Return the vehicle of each client, once it is in: its earlier one, or where that does not come in another.

        Raises `InputError` where fewer vehicles are registered, `OSError` where fewer come in.
        """
        seconds = STARTING_S + STARTING_VEHICLE_S * len(clients)
        end = time.monotonic() + seconds
        while True:
            registry = open_registry(self.folder)
            able = [own for own in registry.list_vehicles() if own.describe_state() == "registered"][self.first :]
            registry.close()
            if len(able) < len(clients):
                told = f"{len(able)} vehicles" + (f" beside {self.first} of other regions" if self.first else "")
                raise InputError(f"{self.folder}: {told}, and the federation has {len(clients)} clients")
            with contextlib.suppress(*SuperLinkLost):
                online = self.link.list_online()
                found = {own.name: own for own in able if own.node in online}
                kept = [own for name in clients if (own := self._vehicles.get(name)) is not None]
                if len(found) >= len(clients) and (found.keys() >= {*kept} or time.monotonic() > end):
                    free = iter([name for name in found if name not in kept])
                    own = {name: self._vehicles.get(name, "") for name in clients}
                    self._vehicles |= {name: old if old in found else next(free) for name, old in own.items()}
                    return [found[self._vehicles[name]] for name in clients]
            if time.monotonic() > end:
                raise OSError(f"{self.folder}: fewer than {len(clients)} vehicles are in after {seconds:g} s")
            time.sleep(LOOK_S)

    def list_requests(self, clients: Iterable[str], task: str) -> dict[str, tuple[bytes, ...]]:
        """Return the FL requests of the vehicles of `clients` for a task that wait for a group, the latest last."""
        registry = open_registry(self.folder)
        try:
            waiting = registry.list_open_requests(time.time() - OPEN_S)
        finally:
            registry.close()
        found: dict[str, tuple[bytes, ...]] = {}
        for client in clients:
            own = tuple(content for vehicle, content in waiting if vehicle == self._vehicles.get(client))
            found[client] = tuple(content for content in own if parse_request(content).task == task)
        return {client: own for client, own in found.items() if own}

    def answer_requests(self, requests: Iterable[bytes]) -> None:
        """Mark FL requests as answered by a group."""
        registry = open_registry(self.folder)
        try:
            registry.answer_requests([parse_request(content).nonce for content in requests], time.time())
        finally:
            registry.close()


class RegionalDeployment:
    """Deployment of several regions: each in a fleet of its own, or side by side in one."""

    deployed: Literal[True] = True

    def __init__(self, folder: Path, clients: Mapping[str, int]) -> None:
        """Find the fleet of each region: in `folder`/REGION where an authority is there, else in `folder` itself.

        clients: number of each region; in one fleet the vehicles of one region come after another's. Raises
        `InputError` where a fleet is not up.
        """
        first, self._fleets = 0, dict[str, Deployment]()
        for region, count in clients.items():
            if (folder / region / AUTHORITY).exists():
                self._fleets[region] = Deployment(folder / region)
            else:
                self._fleets[region] = Deployment(folder, first)
                first += count

    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> contextlib.AbstractContextManager["DeployedGrid"]:
        """Return the grid of a region's `clients`, which are named REGION/VEHICLE, see `Deployment.open`."""
        return self.fleet_of(next(iter(clients))).open(clients, agreed, states, account)

    def fleet_of(self, client: str) -> Deployment:
        """Return the fleet that a client, REGION/VEHICLE, is in."""
        return self._fleets[region_of(client)]

    def beside(self, clients: Collection[str]) -> "RegionalDeployment | PartlyDeployed":
        """Return the deployment where these `clients`, the edge server's own, train in this process."""
        return PartlyDeployed(self, frozenset(clients)) if clients else self


@dataclass(frozen=True)
class PartlyDeployed:
    """A deployment beside the edge server's own clients, such as roadside units, which train in this process."""

    fleet: RegionalDeployment
    own: frozenset[str]  # names of those clients
    deployed: Literal[True] = True

    @contextlib.contextmanager
    def open(
        self, clients: Mapping[str, Trainable], agreed: ClientAgreement, states: ClientStates, account: Account
    ) -> Iterator["JoinedGrid"]:
        """Yield the grid of `clients`, of which the vehicles are deployed, see `Deployment.open`.

        Raises `InputError` under masks, which vehicles have in common with certified vehicles alone.
        """
        if agreed.rules.secure is not None:
            own = min(self.own)
            raise InputError(
                f"secure: {own} trains in the server's process, and vehicles share masks with vehicles alone"
            )
        here = {name: client for name, client in clients.items() if name in self.own}
        there = {name: client for name, client in clients.items() if name not in self.own}
        app = client_app(here, agreed.strategy, agreed.rules, agreed.secrets, agreed.spent)
        with self.fleet.open(there, agreed, states, account) as far:
            yield JoinedGrid(far, EmbeddedGrid(app, [*here], states), [*clients])


class JoinedGrid(LinkGrid):
    """Grid of deployed nodes, and of others in this process."""

    def __init__(self, far: "DeployedGrid", near: EmbeddedGrid, clients: Sequence[str]) -> None:
        """Join two grids, whose nodes stand for `clients`, in their order."""
        self._grid, self._far, self._near, self.follow = far, far, near, far.follow
        nodes = {name: node for grid in (far, near) for node, name in grid.names.items()}
        self.names = {nodes[name]: name for name in clients}

    def read_states(self, keys: Iterable[str]) -> ClientStates:
        """Return the arrays that clients keep between rounds under these records, by client and record."""
        wanted = tuple(keys)
        found = self._far.read_states(wanted) | self._near.read_states(wanted)
        return {name: found[name] for name in self.names.values() if name in found}

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        """Yield the replies, those of this process once the deployed nodes asked before them have answered."""
        asked = [*messages]
        far = [message for message in asked if message.metadata.dst_node_id not in self._near.names]
        answers = iter(self._grid.send_and_receive(far, timeout=timeout))
        for message in asked:
            if message.metadata.dst_node_id in self._near.names:
                yield from self._near.send_and_receive([message])
            elif (answer := next(answers, None)) is not None:
                yield answer


def region_of(client: str) -> str:
    """Return the region of a client that is named REGION/VEHICLE."""
    return client.partition("/")[0]


@contextlib.contextmanager
def start_fleet(vehicles: int) -> Iterator[Deployment]:
    """Yield a fleet of so many vehicles on this machine, in a folder of its own, which ends with the context."""
    with tempfile.TemporaryDirectory(prefix="flcav-fleet-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        found_authority(folder)
        with fleet_up(folder, vehicles):
            yield Deployment(folder)


@contextlib.contextmanager
def fleet_up(folder: Path, vehicles: int, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Yield the process of `flcav fleet up` of a folder, once the fleet is up; it ends with the context."""
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
                told = (folder / LOGS / "up.log").read_text(errors="replace").strip().rpartition("\n")[2]
                raise OSError(f"{folder}: the fleet did not come up: {told}")
            time.sleep(POLL_S)
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
