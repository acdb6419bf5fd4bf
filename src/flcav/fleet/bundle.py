"""The app that vehicles run, as Flower's bundle, and its signature (Ed25519) by the fleet's publisher.

The bundle only names the part of flcav that a vehicle has installed. Nodes run what the publisher signed, and nothing
else: `--trusted-entities` of Flower's SuperNode.
"""

import base64
import hashlib
import json
import time
from pathlib import Path

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519
from flwr.cli.build import build_fab_from_files

from flcav.config import InputError
from flcav.fleet.keys import write_private
from flcav.storage.files import write_bytes

PUBLISHER_KEY, TRUSTED = "publisher.key", "trusted.yaml"
PROJECT = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "flcav-vehicle"
version = "1.0.0"
license = "MIT"
dependencies = []
[tool.flwr.app]
publisher = "flcav"
[tool.flwr.app.components]
serverapp = "flcav_vehicle.server:app"
clientapp = "flcav_vehicle.client:app"
[tool.flwr.app.config]
"""
CLIENT = "from flcav.federation.links.vehicle_app import make_vehicle_app\n\napp = make_vehicle_app()\n"
SERVER = '''"""The server of a federation is the process that asks for it: flcav federate --runtime flower."""
from flwr.serverapp import ServerApp

app = ServerApp()
'''


def build_bundle(client: str = CLIENT) -> bytes:
    """Return the bundle (FAB) of the vehicles' app; `client` is the source of its client module."""
    files: dict[str, bytes | Path] = {
        "pyproject.toml": PROJECT.encode(),
        "flcav_vehicle/__init__.py": b"",
        "flcav_vehicle/client.py": client.encode(),
        "flcav_vehicle/server.py": SERVER.encode(),
    }
    return build_fab_from_files(files)[0]


def make_publisher(folder: Path) -> None:
    """Make the publisher's key in `folder`, and beside it the file of keys that vehicles trust."""
    key = ed25519.Ed25519PrivateKey.generate()
    openssh = serialization.PrivateFormat.OpenSSH
    write_private(
        folder / PUBLISHER_KEY, key.private_bytes(serialization.Encoding.PEM, openssh, serialization.NoEncryption())
    )
    line = key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH).decode()
    write_bytes(folder / TRUSTED, f"{_name_key(key.public_key())}: '{line}'\n".encode())


def sign_bundle(folder: Path, bundle: bytes) -> dict[str, str]:
    """Return the publisher's signature of a bundle as Flower stores it, by the name of the key."""
    key = serialization.load_ssh_private_key((folder / PUBLISHER_KEY).read_bytes(), None)
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise InputError(f"{folder / PUBLISHER_KEY}: an Ed25519 key is wanted")
    now = int(time.time())
    signature = key.sign(now.to_bytes(8, "big") + hashlib.sha256(bundle).digest())
    told = json.dumps({"signed_at": now, "signature": base64.urlsafe_b64encode(signature).decode().rstrip("=")})
    return {"valid_license": "Valid", _name_key(key.public_key()): told}


def _name_key(key: ed25519.Ed25519PublicKey) -> str:
    raw = key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return f"fpk_{hashlib.sha256(raw).hexdigest()[:32]}"
