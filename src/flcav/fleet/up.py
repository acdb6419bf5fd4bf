"""Start-up of a fleet: the SuperLink, the proxy in front of it and, for tests, vehicles on this machine."""

import contextlib
import fcntl
import gc
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from flcav.config import InputError
from flcav.fleet.authority import SERVER, SERVER_KEY, VEHICLE_DAYS, Authority, open_authority, open_registry
from flcav.fleet.keys import (
    AUTHORITY,
    CERTIFICATE,
    REQUEST,
    check_certificate,
    request_certificate,
    take_certificate,
    write_private,
)
from flcav.fleet.proxy import run_proxy
from flcav.fleet.superlink import DATABASE, PUBLISHER_KEY, SECRET, TRUSTED, SuperLink, SuperLinkLost, make_publisher
from flcav.fleet.supervisor import LOGS, supervise
from flcav.fleet.vehicle import SETTINGS, Prepare, VehicleSettings, check_port, vehicle_processes
from flcav.interface.wording import plural
from flcav.storage.files import write_bytes, write_json

READY, VEHICLES, LOCK = "ready.json", "vehicles", "up.lock"
SILENT_S = 60.0  # without an answer of the SuperLink before a warning is printed [s]
CHECK_S = 1.0  # interval of reading the registry [s]
MOST_VEHICLES = 64  # on one machine


@dataclass(frozen=True)
class Ready:
    """The addresses of a running fleet."""

    proxy: str  # host:port
    superlink: str  # host:port on the operator's host
    pid: int  # of the supervisor
    since: int  # [s since 1970]


def read_ready(folder: Path) -> Ready:
    """Return the addresses of the running fleet of `folder`; raises `InputError` if it is not up."""
    try:
        return Ready(**json.loads((folder / READY).read_bytes()))
    except FileNotFoundError:
        raise InputError(f"{folder}: the fleet is not up; flcav fleet up {folder}") from None
    except (ValueError, TypeError):
        raise InputError(f"{folder / READY}: is damaged; flcav fleet up {folder} writes it anew") from None


def name_vehicles(count: int) -> list[str]:
    """Return the identifiers of `count` vehicles on this machine."""
    return [f"vehicle-{number:03d}" for number in range(1, count + 1)]


def prepare_fleet(folder: Path, host: str, port: int, vehicles: int) -> tuple[Authority, str, str]:
    """Prepare the authority's folder for `run_fleet`; return authority, and addresses of proxy and SuperLink.

    port: of the proxy; 0: any free one. vehicles: number whose keys and certificates are made on this machine. Raises
    `InputError` where the port is in use, the folder is another authority's, or a certificate is not in force.
    """
    if not 0 <= vehicles <= MOST_VEHICLES:
        raise InputError(f"--vehicles {vehicles}: 0 to {MOST_VEHICLES} on one machine")
    authority = open_authority(folder)
    proxy = f"{host}:{check_port(host, port)}"
    superlink = f"127.0.0.1:{check_port('127.0.0.1', 0)}"
    if not (folder / PUBLISHER_KEY).exists():
        make_publisher(folder)
    if not (folder / SECRET).exists():
        write_private(folder / SECRET, os.urandom(32).hex().encode())
    for name in name_vehicles(vehicles):
        prepare_vehicle(authority, name, proxy)
    return authority, proxy, superlink


def prepare_vehicle(authority: Authority, name: str, proxy: str, days: float = VEHICLE_DAYS) -> Path:
    """Make key, certificate and settings of a vehicle on this machine; return its folder.

    days: validity of the certificate. Raises `InputError` where an existing certificate is not in force.
    """
    folder = authority.folder / VEHICLES / name
    if not (folder / CERTIFICATE).exists():
        request = folder / REQUEST if (folder / REQUEST).exists() else request_certificate(folder, name)
        take_certificate(folder, authority.register(request, days), (authority.folder / AUTHORITY).read_bytes())
    found = next((each for each in authority.registry.list_vehicles() if each.name == name), None)
    state = "not registered with this authority" if found is None else found.describe_state()
    if state != "registered":
        raise InputError(
            f"{folder / CERTIFICATE}: the certificate of '{name}' is {state}; flcav fleet rotate gives another"
        )
    write_bytes(folder / TRUSTED, (authority.folder / TRUSTED).read_bytes())
    VehicleSettings(proxy, check_port("127.0.0.1", 0), check_port("127.0.0.1", 0)).save(folder)
    return folder


def run_fleet(
    folder: Path,
    host: str,
    port: int,
    vehicles: int,
    prepare: Prepare,
    report: Callable[[str], None],
    others: Mapping[str, Callable[[Path], None]] = {},
) -> None:
    """Run a fleet until this process receives a signal to end; see `prepare_fleet`.

    prepare: see `run_executor`. report: called with a sentence when the fleet is up. others: further processes of every
    vehicle, by name.
    """
    with _alone(folder):
        _, proxy, superlink = prepare_fleet(folder, host, port, vehicles)
        link = SuperLink(folder, superlink)
        state = _Enrolment(folder)
        processes: dict[str, Callable[[], None]] = {
            "superlink": lambda: run_superlink(folder, superlink),
            "proxy": lambda: run_proxy(folder, host, int(proxy.rpartition(":")[2]), superlink),
        }
        later: dict[str, Callable[[], None]] = {}
        for name in name_vehicles(vehicles):
            functions = vehicle_processes(folder / VEHICLES / name, prepare, others)
            later |= {f"{name}-{kind}": do for kind, do in functions.items()}

        begun = time.monotonic()
        silent = True

        def is_up() -> bool:
            nonlocal silent
            up = state.update(link)
            if not up and silent and time.monotonic() > begun + SILENT_S:
                silent = False
                report(f"{folder}: the SuperLink does not answer ({state.wrong}); see {folder / LOGS}")
            if up and not (folder / READY).exists():
                write_json(folder / READY, asdict(Ready(proxy, superlink, os.getpid(), int(time.time()))))
                report(f"{folder}: up at {proxy}, with {plural(vehicles, 'vehicle')} on this machine")
            return up

        (folder / READY).unlink(missing_ok=True)
        import_flower()
        try:
            supervise(folder, processes, later, is_up)
        finally:
            (folder / READY).unlink(missing_ok=True)


def run_vehicle_processes(folder: Path, prepare: Prepare, others: Mapping[str, Callable[[Path], None]] = {}) -> None:
    """Run the vehicle in `folder`, including its further processes `others`, until a signal ends it.

    Raises `InputError` where the vehicle's certificate is not in force.
    """
    if not (folder / SETTINGS).exists():
        raise InputError(f"{folder}: is no vehicle's folder, without {SETTINGS}")
    check_certificate(folder)
    with _alone(folder):
        import_flower()
        supervise(folder, vehicle_processes(folder, prepare, others))


def run_superlink(folder: Path, address: str) -> None:
    """Run `flower-superlink` of the fleet in `folder` in this process until it ends."""
    import sys

    from flwr.superlink.cli.flower_superlink import flower_superlink

    host, _, port = address.rpartition(":")
    sys.argv = [
        "flower-superlink",
        *("--host", host, "--port", port, "--database", str(folder / DATABASE)),
        *("--ssl-certfile", str(folder / SERVER), "--ssl-keyfile", str(folder / SERVER_KEY)),
        *("--ssl-ca-certfile", str(folder / AUTHORITY)),
        *("--enable-supernode-auth", "--disable-runtime-dependency-installation"),
        *("--isolation", "process", "--superexec-auth-secret-file", str(folder / SECRET)),
    ]
    flower_superlink()


def import_flower() -> None:
    """Import the modules of SuperLink and SuperNodes, so that forks of this process share them.

    The modules are frozen for garbage collection in the forks: a full collection only runs once the number of objects
    has grown by a quarter, so that with so many objects the bodies of finished calls would stay in memory.
    """
    import flwr.superlink.cli.flower_superlink
    import flwr.superlink.main
    import flwr.supernode.cli.flower_supernode
    import flwr.supernode.main
    import flwr.supernode.runtime.run_clientapp  # noqa: F401

    gc.collect()
    gc.freeze()
    gc.collect()  # resets the collector's count of objects to almost 0


class _Enrolment:
    """The enrolment of nodes: keeps the SuperLink's nodes equal to the registry's vehicles."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._seen, self._next = folder, -1, 0.0
        self.wrong = ""  # reason of the last failure

    def update(self, link: SuperLink) -> bool:
        """Enrol changes of the registry; return whether the nodes are its vehicles."""
        if time.monotonic() < self._next:
            return self._seen >= 0
        self._next = time.monotonic() + (CHECK_S if self._seen >= 0 else 0.1)
        try:
            with contextlib.closing(open_registry(self._folder)) as registry:
                if (changes := registry.count_changes()) != self._seen:
                    link.enrol(registry)
                    self._seen = changes  # not those since: a vehicle may register while others are enrolled
        except (
            *SuperLinkLost,
            InputError,
            ValueError,
            TypeError,
        ) as error:  # SuperLink starting or absent, or a damaged file
            self.wrong = str(error)
        return self._seen >= 0


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    with (folder / LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{folder}: is up already") from None
        yield
