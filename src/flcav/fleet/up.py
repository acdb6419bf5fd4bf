"""Start of a fleet: the SuperLink, the proxy in front of it and, for tests, vehicles on this machine."""

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
SILENT_S = 60.0  # without an answer of the SuperLink, after which a warning is printed
CHECK_S = 1.0  # between looks at the registry
MOST_VEHICLES = 64  # on this machine


@dataclass(frozen=True)
class Ready:
    """Addresses of a running fleet."""

    proxy: str  # host:port
    superlink: str  # host:port on the operator's host
    pid: int  # of the supervisor
    since: int  # seconds since 1970


def read_ready(folder: Path) -> Ready:
    """Return where the running fleet of `folder` is reached; raises `InputError` where it is not up."""
    try:
        return Ready(**json.loads((folder / READY).read_bytes()))
    except FileNotFoundError:
        raise InputError(f"{folder}: the fleet is not up; flcav fleet up {folder}") from None
    except (ValueError, TypeError):
        raise InputError(f"{folder / READY}: is damaged; flcav fleet up {folder} writes it anew") from None


def name_vehicles(count: int) -> list[str]:
    """Return the identifiers of a number of vehicles on this machine."""
    return [f"vehicle-{number:03d}" for number in range(1, count + 1)]


def prepare_fleet(folder: Path, host: str, port: int, vehicles: int) -> tuple[Authority, str, str]:
    """Make what `run_fleet` needs in the authority's folder; return it, and addresses of proxy and SuperLink.

    port: of the proxy; 0: any that is free. vehicles: whose keys and certificates are made on this machine. Raises
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

    Raises `InputError` where the certificate that is there is not in force.
    """
    own = authority.folder / VEHICLES / name
    if not (own / CERTIFICATE).exists():
        request = own / REQUEST if (own / REQUEST).exists() else request_certificate(own, name)
        take_certificate(own, authority.register(request, days), (authority.folder / AUTHORITY).read_bytes())
    found = next((each for each in authority.registry.list_vehicles() if each.name == name), None)
    state = "not registered with this authority" if found is None else found.describe_state()
    if state != "registered":
        raise InputError(
            f"{own / CERTIFICATE}: the certificate of '{name}' is {state}; flcav fleet rotate gives another"
        )
    write_bytes(own / TRUSTED, (authority.folder / TRUSTED).read_bytes())
    VehicleSettings(proxy, check_port("127.0.0.1", 0), check_port("127.0.0.1", 0)).save(own)
    return own


def run_fleet(
    folder: Path,
    host: str,
    port: int,
    vehicles: int,
    prepare: Prepare,
    report: Callable[[str], None],
    others: Mapping[str, Callable[[Path], None]] = {},
) -> None:
    """Run a fleet until this process gets a signal to end; see `prepare_fleet`.

    prepare: of the vehicles' executors. report: called with a sentence when the fleet is up. others: further processes
    of each vehicle, by name.
    """
    with _alone(folder):
        _, proxy, superlink = prepare_fleet(folder, host, port, vehicles)
        link, state = SuperLink(folder, superlink), _Enrolment(folder)
        processes: dict[str, Callable[[], None]] = {
            "superlink": lambda: run_superlink(folder, superlink),
            "proxy": lambda: run_proxy(folder, host, int(proxy.rpartition(":")[2]), superlink),
        }
        later: dict[str, Callable[[], None]] = {}
        for name in name_vehicles(vehicles):
            own = vehicle_processes(folder / VEHICLES / name, prepare, others)
            later |= {f"{name}-{kind}": do for kind, do in own.items()}

        begun, silent = time.monotonic(), True

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


def run_vehicle(folder: Path, prepare: Prepare, others: Mapping[str, Callable[[Path], None]] = {}) -> None:
    """Run the vehicle in `folder`, with `others` of its processes, until a signal ends it.

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
    """Import what SuperLink and SuperNodes need, so that the forks of this process have it.

    Their collectors leave it alone: they look at all that lives only when it has grown by a quarter, and of so much
    they would keep the bodies of calls that are over.
    """
    import flwr.superlink.cli.flower_superlink
    import flwr.superlink.main
    import flwr.supernode.cli.flower_supernode
    import flwr.supernode.main
    import flwr.supernode.runtime.run_clientapp  # noqa: F401

    gc.collect()
    gc.freeze()
    gc.collect()  # now of next to nothing


class _Enrolment:
    """The nodes of the SuperLink are made those of the registry whenever either has changed."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._seen, self._next = folder, -1, 0.0
        self.wrong = ""  # why it is not so

    def update(self, link: SuperLink) -> bool:
        """Bring the enrolled nodes up to date; return whether they are the registry's vehicles."""
        if time.monotonic() < self._next:
            return self._seen >= 0
        self._next = time.monotonic() + (CHECK_S if self._seen >= 0 else 0.1)
        try:
            with contextlib.closing(open_registry(self._folder)) as registry:
                if registry.count_changes() != self._seen:
                    link.enrol(registry)
                    self._seen = registry.count_changes()
        except (*SuperLinkLost, InputError, ValueError, TypeError) as error:  # not there yet, or not now; or damaged
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
