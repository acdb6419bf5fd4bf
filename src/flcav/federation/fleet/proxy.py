"""The fleet's reverse proxy before Flower's SuperLink: it only admits registered certificates and calls of nodes.

A call passes where its path is one of a node's under `/v1/fleet/`, its TLS connection has the certificate of a vehicle
that is in the registry, neither revoked nor replaced nor expired at that moment, and Flower's node key is that
vehicle's. FL requests and releases, which need the certificate alone, are for the proxy itself. The control side of the
SuperLink listens on the operator's host alone.
"""

import asyncio
import base64
import binascii
import hashlib
import sqlite3
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_public_key
from starlette.types import Receive, Scope, Send

from flcav.federation.fleet.authority import SERVER, SERVER_KEY, open_registry
from flcav.federation.fleet.keys import AUTHORITY, public_der
from flcav.federation.fleet.mutual_tls import CERTIFICATE, CONNECTION, Connection, serve_https
from flcav.federation.fleet.registry import Registry, Vehicle
from flcav.federation.fleet.relay import TIMEOUT, answer, keep_alive, read_body, relay
from flcav.federation.fleet.releases.service import answer_release
from flcav.federation.fleet.traffic import Traffic, read_traffic
from flcav.federation.messages.fl_request import LARGEST, check_age, parse_request
from flcav.federation.messages.fl_request import PATH as REQUEST_PATH
from flcav.federation.messages.release_report import RELEASES

FLEET = "/v1/fleet/"
CALLS = frozenset(
    {
        "activate-node",
        "deactivate-node",
        "send-node-heartbeat",
        "pull-messages",
        "push-messages",
        "get-run",
        "get-fab",
        "push-object",
        "pull-object",
        "confirm-message-received",
    }
)  # of a node; registering one is the authority's
NODE_KEY = b"flwr-public-key"  # header: of the node, PEM in base 64
SIGNED_AT = b"flwr-timestamp"  # header: when the node signed
OLDEST_S = 300.0  # of a signature that Flower accepts
SAVE_S = 0.5  # between savings of what was counted


class FleetProxy:
    """ASGI app in front of a SuperLink."""

    def __init__(self, registry: Registry, client: httpx.AsyncClient, folder: Path) -> None:
        self._registry, self._client, self._folder = registry, client, folder
        self._traffic, self._changed = read_traffic(folder), False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a vehicle's call on, or refuse it: 401 for who calls, 403 for what is called."""
        if scope["type"] == "lifespan":
            saving = asyncio.create_task(self._save())
            while not await keep_alive(receive, send):
                pass
            saving.cancel()
            self._traffic.save(self._folder)
            return
        state, path = scope["state"], scope["path"]
        vehicle = find_caller(self._registry, state[CERTIFICATE])
        if isinstance(vehicle, str):
            await self._refuse(send, 401, state[CERTIFICATE], vehicle)
            return
        if path == REQUEST_PATH and scope["method"] == "POST":
            await self._take_request(vehicle.name, receive, send)
            return
        if path.startswith(RELEASES):
            await self._answer_release(vehicle.name, scope, receive, send)
            return
        call = path.removeprefix(FLEET)
        if scope["method"] != "POST" or path != FLEET + call or call not in CALLS:
            await self._refuse(send, 403, vehicle.name, f"{scope['method']} {path[:100]} is no call of a vehicle's")
            return
        if node_key(dict(scope["headers"]).get(NODE_KEY, b"")) != vehicle.public_key:
            await self._refuse(send, 401, vehicle.name, "the node's key is not the certificate's")
            return
        done = await relay(self._client, scope, receive, send)
        if done.status == httpx.codes.UNAUTHORIZED:
            self._traffic.refuse(vehicle.name, describe_clock(dict(scope["headers"]).get(SIGNED_AT, b"")))
        connection: Connection = state[CONNECTION]
        self._traffic.count(vehicle.name, call, done.up, done.down, connection.count_bytes(), done.status)
        self._changed = True

    async def _take_request(self, vehicle: str, receive: Receive, send: Send) -> None:
        """Keep a vehicle's FL request, or refuse it: 400 for another message, 409 for one that came before."""
        try:
            request = parse_request(content := await read_body(receive, LARGEST))
        except ValueError as error:
            await self._refuse(send, 400, vehicle, str(error))
            return
        now = time.time()
        if (odd := check_age(request, now)) is not None:
            await self._refuse(send, 400, vehicle, odd)
            return
        try:
            why = await asyncio.to_thread(self._keep_request, vehicle, request.nonce, content, now)
        except sqlite3.Error as error:
            await self._refuse(send, 503, vehicle, f"the registry cannot be written: {error}")
            return
        if why is not None:
            await self._refuse(send, 409, vehicle, why)
            return
        await answer(send, 200, "the request is taken")

    def _keep_request(self, *about: Any) -> str | None:
        registry = open_registry(self._folder)
        try:
            return registry.take_request(*about)
        finally:
            registry.close()

    async def _answer_release(self, vehicle: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Send a file of the repositories on offer, keep a vehicle's report, or refuse its call."""
        connection: Connection = scope["state"][CONNECTION]

        def count() -> int:
            self._changed = True
            return self._traffic.count_release(vehicle, connection.count_bytes())

        refused = await answer_release(self._folder, vehicle, scope, receive, send, count)
        if refused is not None:
            await self._refuse(send, refused[0], vehicle, refused[1])
        count()

    async def _refuse(self, send: Send, status: int, who: str | bytes | None, why: str) -> None:
        told = who if isinstance(who, str) else "nobody" if who is None else hashlib.sha256(who).hexdigest()[:16]
        self._traffic.refuse(told, why)
        self._changed = True
        await answer(send, status, why)

    async def _save(self) -> None:
        while True:
            await asyncio.sleep(SAVE_S)
            if self._changed:
                self._changed = False
                try:
                    now = Traffic(dict(self._traffic.vehicles), self._traffic.refused)
                    await asyncio.to_thread(now.save, self._folder)
                except OSError:  # no room: what was counted is written later
                    self._changed = True


def find_caller(registry: Registry, certificate: bytes | None, now: float | None = None) -> Vehicle | str:
    """Return the vehicle whose certificate (DER) is in force, or in words why nobody's is."""
    if certificate is None:
        return "a certificate is wanted"
    found = registry.find(hashlib.sha256(certificate).hexdigest())
    if found is None:
        return "the certificate is not registered"
    now = time.time() if now is None else now
    state = found.describe_state(now)
    return (
        found if state == "registered" and now >= found.issued - 60 else f"the certificate of {found.name} is {state}"
    )


def describe_clock(signed_at: bytes, now: float | None = None) -> str:
    """Return in words why Flower refused a node's signature: most often its clock; `signed_at` is its header."""
    try:
        late = (time.time() if now is None else now) - datetime.fromisoformat(signed_at.decode("ascii")).timestamp()
    except (ValueError, OverflowError):
        return "the SuperLink refuses its signature, which has no time"
    if abs(late) >= OLDEST_S:
        return (
            f"the SuperLink refuses its signature: its clock is {abs(late):.0f} s {'behind' if late > 0 else 'ahead'}"
        )
    return "the SuperLink refuses its signature, or does not know its key"


def node_key(header: bytes) -> bytes:
    """Return the public key in Flower's header as DER; empty where it has none."""
    try:
        key = load_pem_public_key(base64.b64decode(header, validate=True))
    except (ValueError, binascii.Error):
        return b""
    return public_der(key) if isinstance(key, ec.EllipticCurvePublicKey) else b""


def run_proxy(folder: Path, host: str, port: int, superlink: str) -> None:
    """Run the proxy of the fleet in `folder` until the process is ended; `superlink` is host:port of the SuperLink."""
    client = httpx.AsyncClient(
        base_url=f"https://{superlink}", verify=str(folder / AUTHORITY), timeout=TIMEOUT, trust_env=False
    )
    app = FleetProxy(open_registry(folder), client, folder)
    serve_https(app, host, port, folder / SERVER, folder / SERVER_KEY, folder / AUTHORITY).run()
