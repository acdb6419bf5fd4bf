"""Installation on a vehicle: its certificate, the keys that it trusts, and the address of the fleet."""

import re
from pathlib import Path

import yaml

from flcav.config import InputError
from flcav.fleet.bundle import TRUSTED
from flcav.fleet.keys import take_certificate
from flcav.fleet.up import check_port
from flcav.fleet.vehicle import VehicleSettings
from flcav.plugins import PLACE
from flcav.storage.files import write_bytes


def install_vehicle(
    folder: Path, certificate: Path, authority: Path, trusted: Path, server: str, client: str = ""
) -> None:
    """Install the authority's files in a vehicle's folder; raises `InputError` for a file of another kind.

    server: host:port of the proxy. client: module:NAME of the vehicle's own part in a federation, an `Assignment`
    of `runtimes.vehicle_app`; "": the one that is put into its folder.
    """
    if client and not PLACE.fullmatch(client):
        raise InputError(f"--client {client[:80]}: a module, a colon and a name in it are wanted")
    if not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[A-Za-z0-9.-]+):[0-9]{1,5}", server):
        raise InputError(f"--server {server[:80]}: HOST:PORT is wanted")
    keys = trusted.read_bytes()
    try:
        named = yaml.safe_load(keys)
    except (yaml.YAMLError, ValueError, RecursionError):
        named = None
    if not isinstance(named, dict) or not named:
        raise InputError(f"{trusted}: names no key that apps are signed by")
    take_certificate(folder, certificate.read_bytes(), authority.read_bytes())
    write_bytes(folder / TRUSTED, keys)
    VehicleSettings(server, check_port("127.0.0.1", 0), check_port("127.0.0.1", 0), client).save(folder)
