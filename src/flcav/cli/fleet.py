"""`flcav fleet`: certificates and registry of a deployed fleet, and its processes."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_finite
from flcav.cli.terminal import Answer, answer_json, echo
from flcav.interface.wording import make_printable, plural

if TYPE_CHECKING:
    from flcav.fleet.registry import RegisteredVehicle, VehicleRegistry

fleet = typer.Typer(
    help="A deployed fleet: its registered vehicles, its servers, and what they do.", no_args_is_help=True
)
FLEET = typer.Argument(help="Folder of the fleet's authority.")
REQUEST = typer.Argument(help="Signing request of the vehicle (PKCS #10), made by flcav fleet key.")
DAYS = typer.Option(
    365.0, "--days", min=0.0001, max=3650.0, callback=check_finite, help="Days until the certificate expires."
)
CERTIFICATE = typer.Option(..., "--out", help="File of the certificate (PEM), which goes to the vehicle.")


@fleet.callback()
def guard() -> None:
    """Let nobody but its owner write what a command writes, whatever the umask of the terminal."""
    import os

    os.umask(os.umask(0o077) | 0o022)


@fleet.command()
def init(
    folder: Path = typer.Argument(help="New folder, on the operator's host."),
    host: list[str] = typer.Option(
        [], "--host", help="Name or address that vehicles reach the proxy by; may be given several times."
    ),
) -> None:
    """Make the authority of a new fleet: its key and certificate, its registry, and the servers' certificate."""
    from flcav.fleet.authority import found_authority
    from flcav.fleet.superlink import make_publisher

    found_authority(folder, tuple(host))
    make_publisher(folder)
    echo(f"{folder}: authority, registry, and the key that apps are signed by")


@fleet.command()
def key(
    folder: Path = typer.Argument(help="Folder of the vehicle, on the vehicle."),
    vehicle: str = typer.Option(..., "--vehicle", help="Unique identifier of the vehicle: a-z 0-9 . _ -"),
) -> None:
    """On a vehicle: make its key, which never leaves the folder, and the signing request that goes to the authority."""
    from flcav.fleet.keys import request_certificate

    echo(f"{request_certificate(folder, vehicle)}: signing request of {vehicle}")


@fleet.command("register")
def register_vehicle(
    folder: Path = FLEET, request: Path = REQUEST, out: Path = CERTIFICATE, days: float = DAYS
) -> None:
    """Register a vehicle by its signing request, and certify its key."""
    from flcav.fleet.authority import open_authority
    from flcav.storage.files import write_bytes

    authority = open_authority(folder)
    certificate = authority.register(request, days)
    write_bytes(out, certificate)
    echo(f"{out}: {_describe_new(authority.registry, certificate)}")


@fleet.command()
def rotate(folder: Path = FLEET, request: Path = REQUEST, out: Path = CERTIFICATE, days: float = DAYS) -> None:
    """Certify a registered vehicle's new key; its certificate before is refused from now on."""
    from flcav.fleet.authority import open_authority
    from flcav.storage.files import write_bytes

    authority = open_authority(folder)
    certificate = authority.rotate(request, days)
    write_bytes(out, certificate)
    echo(f"{out}: {_describe_new(authority.registry, certificate)}")


@fleet.command()
def install(
    folder: Path = typer.Argument(help="Folder of the vehicle, on the vehicle."),
    certificate: Path = typer.Argument(help="Certificate that the authority gave (PEM)."),
    authority: Path = typer.Option(..., "--authority", help="The authority's certificate, ca.crt of the fleet."),
    trusted: Path = typer.Option(..., "--trusted", help="Who signs apps, trusted.yaml of the fleet."),
    server: str = typer.Option(..., "--server", help="Where the proxy is reached: HOST:PORT."),
    client: str = typer.Option(
        "",
        "--client",
        help="Its own part in a federation, module:NAME; by default the one that is put into its folder.",
    ),
) -> None:
    """On a vehicle: put its certificate to use, and set where the fleet is reached."""
    from flcav.fleet.vehicle import install_vehicle

    install_vehicle(folder, certificate, authority, trusted, server, client)
    echo(f"{folder}: ready; flcav fleet vehicle {folder} runs it")


@fleet.command()
def revoke(
    folder: Path = FLEET,
    vehicle: str = typer.Argument(help="Identifier of the vehicle."),
    reason: str = typer.Option("", "--reason", help="Kept in the audit trail."),
) -> None:
    """Revoke a vehicle's certificate: it is refused from its next call on."""
    from flcav.fleet.authority import open_registry

    open_registry(folder).revoke(vehicle, reason)
    echo(f"{vehicle}: revoked")


@fleet.command("list")
@answer_json
def list_vehicles(
    folder: Path = FLEET,
    audit: bool = typer.Option(False, "--audit", help="List the changes of the registry instead."),
) -> Answer:
    """List the registered vehicles with the state and expiry of their certificates."""
    from dataclasses import asdict

    from flcav.fleet.authority import open_registry

    registry = open_registry(folder)
    if audit:
        entries = registry.list_audit()
        yield {"audit": [asdict(entry) for entry in entries]}
        for entry in entries:
            line = f"{_date(entry.time)} {entry.action} {entry.vehicle} {entry.fingerprint[:16]} {entry.reason}"
            yield make_printable(line.rstrip(), 600)
        return
    vehicles = registry.list_vehicles()
    rows = [
        {
            "name": vehicle.name,
            "state": vehicle.describe_state(),
            "fingerprint": vehicle.fingerprint,
            "issued": vehicle.issued,
            "expires": vehicle.expires,
            "node": vehicle.node,
        }
        for vehicle in vehicles
    ]
    yield {"vehicles": rows}
    yield from map(_describe, vehicles)
    yield plural(len(vehicles), "vehicle")


@fleet.command()
@answer_json
def status(
    folder: Path = FLEET,
    page: int | None = typer.Option(
        None, "--page", min=0, max=65535, help="Serve a page that follows the fleet, on this port of this host; 0: any."
    ),
) -> Answer:
    """Tell who is in, the rounds of the federation, bytes against budgets, failures and refusals."""
    from flcav.fleet.status import LEAST_ROOM, read_fleet_status

    if page is not None:
        from flcav.fleet.page import serve_page

        serve_page(folder, page, echo)
        return
    found = read_fleet_status(folder)
    yield found.as_json()
    yield "not up" if found.proxy is None else f"up at {found.proxy}, processes: {len(found.processes)}"
    for vehicle in found.vehicles:
        there = "online" if vehicle.online else "offline"
        yield (
            f"{vehicle.name}: {vehicle.state}, {there}; {vehicle.socket_up} bytes up and {vehicle.socket_down} down "
            f"crossed its sockets, {vehicle.content_up} and {vehicle.content_down} of them content"
        )
        if vehicle.release is not None:
            yield f"    {vehicle.release.describe()}"
    if found.federation is not None:
        yield found.federation.describe()
    for pending in found.requests:
        yield pending.describe()
    for refusal in found.refused:
        yield f"refused: {refusal}"
    if found.free < LEAST_ROOM:
        yield f"{folder}: no room on its disk, {found.free} bytes are free"


@fleet.command()
def request(
    folder: Path = typer.Argument(help="Folder of the vehicle, on the vehicle."),
    task: str = typer.Option(..., "--task", help="Name of the task."),
    loss: float = typer.Option(
        ..., "--loss", callback=check_finite, help="Of the network that drives, on frames held back from training."
    ),
    frames: int = typer.Option(..., "--frames", min=1, help="Number of these frames."),
    at: tuple[float, float] = typer.Option(..., "--at", help="Position of the vehicle: X Y [m]."),
) -> None:
    """On a vehicle: ask the fleet for federated learning; a request is taken once."""
    from flcav.fleet.fl_request import make_request
    from flcav.fleet.forwarder import send_request
    from flcav.fleet.vehicle import load_settings

    made = make_request(task, loss, frames, at)
    send_request(folder, load_settings(folder).server, made)
    echo(f"{folder}: the request {made.nonce} is taken")


@fleet.command()
def up(
    folder: Path = FLEET,
    vehicles: int | None = typer.Option(
        None, "--vehicles", min=1, max=64, help="Vehicles on this machine, too. Without: servers alone."
    ),
    host: str = typer.Option("127.0.0.1", "--host", help="Address that the proxy listens on."),
    port: int = typer.Option(0, "--port", min=0, max=65535, help="Port of the proxy; 0: a free one."),
) -> None:
    """Run the SuperLink and the proxy of a fleet until interrupted, and vehicles on this machine."""
    from flcav.federation.links.vehicle_app import preload_assignment
    from flcav.fleet.up import run_fleet

    run_fleet(folder, host, port, vehicles or 0, preload_assignment, echo, _updater())


@fleet.command("vehicle")
def run_vehicle(folder: Path = typer.Argument(help="Folder of the vehicle, on the vehicle.")) -> None:
    """On a vehicle: run its forwarder, its node and its app until interrupted."""
    from flcav.federation.links.vehicle_app import preload_assignment
    from flcav.fleet.up import run_vehicle_processes as run

    run(folder, preload_assignment, _updater())


def _updater() -> dict[str, Callable[[Path], None]]:
    """Return the updater process of vehicles, which follows releases; empty without its optional dependency."""
    from importlib.util import find_spec

    if find_spec("tuf") is None:
        return {}
    from flcav.releases.rollout.updater import run_updater

    return {"updater": run_updater}


def _describe_new(registry: "VehicleRegistry", certificate: bytes) -> str:
    from flcav.fleet.keys import fingerprint_of

    vehicle = registry.find(fingerprint_of(certificate))
    assert vehicle is not None
    return _describe(vehicle)


def _describe(vehicle: "RegisteredVehicle") -> str:
    validity = f"{vehicle.describe_state()}, until {_date(vehicle.expires)}"
    return f"{vehicle.name} {validity}, SHA-256 {vehicle.fingerprint[:16]}"


def _date(seconds: int) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
