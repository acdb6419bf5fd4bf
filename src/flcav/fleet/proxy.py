"""The fleet's reverse proxy in front of Flower's SuperLink: it only admits registered certificates and calls of nodes.

A call passes if its path is a node's call under `/v1/fleet/`, its TLS connection has the certificate of a registered
vehicle, at that moment neither revoked nor replaced nor expired, and Flower's node key is that vehicle's. FL requests
and releases only need the certificate, and are answered by the proxy itself. The control interface of the SuperLink
only listens on the operator's host.
"""

import asyncio
import base64
import binascii
import contextlib
import hashlib
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_public_key
from starlette.types import Message, Receive, Scope, Send

from flcav.config import InputError
from flcav.fleet import relay
from flcav.fleet.authority import REGISTRY, SERVER, SERVER_KEY, open_registry
from flcav.fleet.fl_request import LARGEST, check_age, parse_request
from flcav.fleet.fl_request import PATH as REQUEST_PATH
from flcav.fleet.keys import AUTHORITY, public_der
from flcav.fleet.mutual_tls import CERTIFICATE, CONNECTION, IN_ALL, ClientConnection, serve_https
from flcav.fleet.registry import RegisteredVehicle, VehicleRegistry
from flcav.fleet.releases import LARGEST_REPORT, RELEASES, REPORT, KeptReport, find_offered, parse_report
from flcav.fleet.traffic import ProxyTraffic, read_traffic
from flcav.interface.wording import make_printable

OLDEST_S = 300.0  # largest age of a signature that Flower accepts [s]
SAVE_S = 0.5  # interval of saving the traffic counts [s]
BUSY_S = 0.1  # timeout of a call for a registry locked by another process [s]
LIMITS = httpx.Limits(max_connections=IN_ALL, max_keepalive_connections=20)  # to the SuperLink
AT_ONCE = 2  # simultaneous uploads of objects per vehicle, as many as Flower sends


class FleetProxy:
    """The proxy's ASGI app in front of a SuperLink."""

    def __init__(self, client: httpx.AsyncClient, folder: Path) -> None:
        self._client, self._folder = client, folder
        self._registry: VehicleRegistry | None = None
        self._file: tuple[int, int] | None = None  # device and inode of the registry's file
        self._objects = defaultdict[str, asyncio.Semaphore](lambda: asyncio.Semaphore(AT_ONCE))
        self._traffic = read_traffic(folder)
        self._changed = True
        self._traffic.lose_all()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a vehicle's call on, or refuse it: 401 for an unauthenticated caller, 403 for a forbidden call."""
        if scope["type"] == "lifespan":
            saving = asyncio.create_task(self._save())
            while not await relay.keep_alive(receive, send):
                pass
            saving.cancel()
            self._traffic.save(self._folder)
            return
        connection: ClientConnection = scope["state"][CONNECTION]
        certificate: bytes | None = scope["state"][CERTIFICATE]
        caller: str | bytes | None = certificate

        async def soon(event: Message) -> None:
            async with asyncio.timeout(relay.QUIET_S):
                await send(event)

        try:
            try:
                vehicle = self.find(certificate)
                caller = vehicle.name
                await self._answer(vehicle, scope, receive, soon)
            except relay.RelayRefused as refused:
                await self._refuse(soon, refused.status, caller, refused.why)
        except TimeoutError:  # the client does not read its answer
            connection.abort()

    async def _answer(self, vehicle: RegisteredVehicle, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope["path"]
        headers = relay.check_headers(scope["headers"])
        came = time.time()
        if path == REQUEST_PATH and scope["method"] == "POST":
            await self._take_request(vehicle.name, scope, receive, send)
            return
        if path.startswith(RELEASES):
            await self._answer_release(vehicle.name, scope, receive, send)
            return
        call = path.removeprefix(relay.FLEET)
        if scope["method"] != "POST" or path != relay.FLEET + call or call not in relay.CALLS:
            raise relay.RelayRefused(403, f"{scope['method']} {path[:100]} is no call of a vehicle's")
        if node_key(headers.get(relay.NODE_KEY, b"")) != vehicle.public_key:
            raise relay.RelayRefused(401, "the node's key is not the certificate's")
        passed = [*relay.choose_headers(headers), relay.name_key(vehicle)]
        gone = False
        connection: ClientConnection = scope["state"][CONNECTION]

        async def checked(event: Message) -> None:
            nonlocal gone
            gone |= connection.is_closed()
            await send(event)

        # bodies of objects are held in memory while they are relayed, which bounds a vehicle's share of it
        slot = self._objects[vehicle.name] if call == "push-object" else contextlib.nullcontext()
        async with slot:
            body = await relay.read_body(scope, receive, relay.largest_body(call))
            vehicle = self.find(scope["state"][CERTIFICATE])  # its certificate may have been revoked meanwhile
            done = await relay.relay(self._client, path, passed, relay.check_body(call, body, vehicle), checked)
        if done.status == httpx.codes.UNAUTHORIZED:
            self._traffic.refuse(vehicle.name, describe_clock(headers.get(relay.SIGNED_AT, b""), came))
        self._traffic.count(vehicle.name, call, done.up, done.down, connection.count_bytes(), done.status, gone)
        self._changed = True

    def find(self, certificate: bytes | None) -> RegisteredVehicle:
        """Return the vehicle whose certificate (DER) is in force; raises `RequestRefused` where there is none.

        The registry is reopened where its file was replaced, or could not be read.
        """
        try:
            found = (self._folder / REGISTRY).stat()
            if self._registry is None or self._file != (found.st_dev, found.st_ino):
                self._close()
                self._registry = open_registry(self._folder, BUSY_S)
                self._file = found.st_dev, found.st_ino
            vehicle = find_caller(self._registry, certificate)
        except (InputError, OSError, ValueError, TypeError):
            self._close()
            raise relay.RelayRefused(503, "the fleet's registry cannot be read") from None
        if isinstance(vehicle, str):
            raise relay.RelayRefused(401, vehicle)
        return vehicle

    def _close(self) -> None:
        if self._registry is not None:
            self._registry.close()
        self._registry = None

    def find_owner(self, certificate: bytes | None) -> str:
        """Return the vehicle that a connection counts for; all without a certificate in force count as one."""
        try:
            return self.find(certificate).name
        except relay.RelayRefused:
            return ""

    async def _take_request(self, vehicle: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Store a vehicle's FL request, or refuse it: 400 for an invalid message, 409 for a replay."""
        content = await relay.read_body(scope, receive, LARGEST)
        try:
            request = parse_request(content)
        except ValueError as error:
            raise relay.RelayRefused(400, str(error)) from None
        now = time.time()
        if (wrong_age := check_age(request, now)) is not None:
            raise relay.RelayRefused(400, wrong_age)
        try:
            why = await asyncio.to_thread(self._keep_request, vehicle, request.nonce, content, now)
        except (InputError, OSError) as error:
            raise relay.RelayRefused(503, f"the registry cannot be written: {error}") from None
        if why is not None:
            raise relay.RelayRefused(409, why)
        await relay.answer(send, 200, "the request is taken")

    def _keep_request(self, *about: Any) -> str | None:
        registry = open_registry(self._folder)
        try:
            return registry.take_request(*about)
        finally:
            registry.close()

    async def _answer_release(self, vehicle: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Send a file of the offered repositories, store a vehicle's report, or refuse its call."""
        connection: ClientConnection = scope["state"][CONNECTION]

        def count() -> int:
            self._changed = True
            return self._traffic.count_release(vehicle, connection.count_bytes())

        try:
            await answer_release(self._folder, vehicle, scope, receive, send, count)
        finally:
            count()

    async def _refuse(self, send: Send, status: int, who: str | bytes | None, why: str) -> None:
        caller = who if isinstance(who, str) else "nobody" if who is None else hashlib.sha256(who).hexdigest()[:16]
        plain = make_printable(why)
        self._traffic.refuse(caller, plain)
        self._changed = True
        await relay.answer(send, status, plain)

    async def _save(self) -> None:
        while True:
            await asyncio.sleep(SAVE_S)
            if self._changed:
                self._changed = False
                try:
                    now = ProxyTraffic(dict(self._traffic.vehicles), self._traffic.refused)
                    await asyncio.to_thread(now.save, self._folder)
                except OSError:  # a full disk: the counts are written later
                    self._changed = True


def find_caller(
    registry: VehicleRegistry, certificate: bytes | None, now: float | None = None
) -> RegisteredVehicle | str:
    """Return the vehicle whose certificate (DER) is in force at `now` [s since 1970], or a sentence why none is."""
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
    """Return a sentence on why Flower refused a node's signature, usually its clock.

    signed_at: header with the time of signing. now: [s since 1970].
    """
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
    """Return the public key in Flower's header as DER; empty if there is none."""
    try:
        key = load_pem_public_key(base64.b64decode(header, validate=True))
    except (ValueError, binascii.Error):
        return b""
    return public_der(key) if isinstance(key, ec.EllipticCurvePublicKey) else b""


def run_proxy(folder: Path, host: str, port: int, superlink: str) -> None:
    """Run the proxy of the fleet in `folder` until the process is ended; `superlink` is host:port of the SuperLink."""
    client = httpx.AsyncClient(
        base_url=f"https://{superlink}",
        verify=str(folder / AUTHORITY),
        timeout=relay.TIMEOUT,
        trust_env=False,
        limits=LIMITS,
    )
    app = FleetProxy(client, folder)
    keys = folder / SERVER, folder / SERVER_KEY, folder / AUTHORITY
    serve_https(app, host, port, *keys, app.find_owner).run()


async def answer_release(
    fleet: Path, vehicle: str, scope: Scope, receive: Receive, send: Send, count: Callable[[], int]
) -> None:
    """Answer a registered vehicle's call for releases; raises `RequestRefused`.

    count: called after every piece that is sent; returns the bytes of this vehicle's releases so far.
    """
    name, method = scope["path"].removeprefix(RELEASES), scope["method"]
    if method == "POST" and name == REPORT:
        await _take_report(fleet, vehicle, await relay.read_body(scope, receive, LARGEST_REPORT), count)
        await relay.answer(send, 200, "the report is taken")
        return
    if method != "GET":
        raise relay.RelayRefused(403, f"{method} {scope['path'][:100]} is no call of a vehicle's")
    try:
        path = await asyncio.to_thread(find_offered, fleet, name)
    except ValueError as error:
        raise relay.RelayRefused(403, f"{scope['path'][:100]} {error}") from None
    if path is None:
        await relay.answer(send, 404, "no such file is on offer")
    else:
        await relay.send_file(send, path, count)


async def _take_report(fleet: Path, vehicle: str, content: bytes, count: Callable[[], int]) -> None:
    try:
        report = parse_report(content)
    except ValueError as error:
        raise relay.RelayRefused(400, str(error)) from None
    if report.shadow is not None:  # the certificate determines the vehicle
        report = replace(report, shadow=replace(report.shadow, vehicle=vehicle))
    try:
        await asyncio.to_thread(KeptReport(vehicle, time.time(), count(), report).save, fleet)
    except OSError as error:
        raise relay.RelayRefused(503, f"the report cannot be kept: {error}") from None
