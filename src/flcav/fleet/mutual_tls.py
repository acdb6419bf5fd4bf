"""Mutual TLS: a uvicorn server that passes the client certificate of each request to its app, within limits.

`scope["state"]` of a request has the client's certificate (DER; None: it has none) and its connection, whose bytes are
read where they cross: the kernel counts those of a TCP socket (TCP_INFO, Linux), TLS records included.

A connection that has sent no whole request is closed after some seconds, and where there are too many, the oldest of
the client with most gives way: so a crowd of idle connections keeps nobody else out.
"""

import asyncio
import contextlib
import gc
import resource
import socket
import ssl
import struct
from asyncio import sslproto
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

CERTIFICATE, CONNECTION = "certificate", "connection"  # keys of the state
RECEIVED_AT, SENT_AT, INFO_BYTES = 128, 200, 216  # tcpi_bytes_received, tcpi_bytes_sent and _retrans in linux/tcp.h
HANDSHAKES, OF_EACH, IN_ALL = 256, 16, 768  # connections: before a certificate is known; of one client; all with one
FILES = 4096  # that a server may have open, where the system lets it: those, and as many to where it passes calls on
BACKLOG = 128  # connections that the kernel keeps until they are accepted
HANDSHAKE_S, HEADER_S, CLOSE_S = 10.0, 10.0, 2.0  # for TLS's handshake; for each request's header; for TLS's farewell
LARGEST_HEADER = 8192  # bytes
SWEPT = 256  # connections after which what is left of them is looked for: asyncio's TLS refers to itself
BUFFER = 1 << 15  # bytes that each connection of asyncio's TLS has from its beginning, in the place of 256 KiB

Key = TypeVar("Key")


class ClientConnection:
    """A client's connection, and how many of its bytes were counted already."""

    def __init__(self, transport: Any) -> None:
        self._socket, self.abort = transport.get_extra_info("socket"), transport.abort
        self.is_closed = transport.is_closing
        self._counted = (0, 0)

    def count_bytes(self) -> tuple[int, int]:
        """Return the bytes received and sent since the last call; zeros where the system does not report them."""
        if not hasattr(socket, "TCP_INFO"):
            return 0, 0
        try:
            info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, INFO_BYTES)
        except OSError:  # closed
            return 0, 0
        if len(info) < INFO_BYTES:
            return 0, 0
        (received,), (sent, again) = (
            struct.unpack_from("=Q", info, RECEIVED_AT),
            struct.unpack_from("=QQ", info, SENT_AT),
        )
        before, self._counted = self._counted, (received, sent - again)
        return received - before[0], sent - again - before[1]


def find_superfluous(owners: Mapping[Key, Hashable], of_each: int, most: int) -> Key | None:
    """Return the connection that is to give way: the oldest of the client with most; None where there are not too many.

    owners: of the connections, the oldest first. of_each: connections that one of them may have. most: of all.
    """
    counts = Counter(owners.values()).most_common(1)
    if not counts or (counts[0][1] <= of_each and len(owners) <= most):
        return None
    return next(key for key, owner in owners.items() if owner == counts[0][0])


class Door(socket.socket):
    """Listening socket that closes a TCP connection whose handshake is under way where there are too many."""

    def __init__(self, *about: Any) -> None:
        super().__init__(*about)
        self._accepted: dict[int, tuple[socket.socket, str]] = {}  # by file descriptor: connections, their addresses
        self._count = 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; the one that gives way is shut down, which ends its handshake."""
        connection, address = super().accept()
        self._count += 1
        if self._count % SWEPT == 0:
            gc.collect()
        self._accepted = {fd: each for fd, each in self._accepted.items() if each[0].fileno() == fd}  # others ended
        self._accepted[connection.fileno()] = connection, address[0]
        hosts = {fd: host for fd, (_, host) in self._accepted.items()}
        if (odd := find_superfluous(hosts, HANDSHAKES, HANDSHAKES)) is not None:
            with contextlib.suppress(OSError):  # it has left
                self._accepted.pop(odd)[0].shutdown(socket.SHUT_RDWR)
        return connection, address

    def let_in(self, connection: Any) -> None:
        """Note that the handshake of a connection is over."""
        self._accepted.pop(connection.fileno(), None)


class CertifiedProtocol(H11Protocol):
    """HTTP/1.1 of uvicorn, with the client's certificate and connection in the state of each request."""

    def __init__(
        self,
        *args: Any,
        door: Door,
        inside: dict["CertifiedProtocol", Hashable],
        find_owner: Callable[[bytes | None], Hashable],
        **more: Any,
    ) -> None:
        """Belong to the connections `inside`, with their owners, of which `find_owner` finds one by its certificate."""
        super().__init__(*args, **more)
        self._door, self._inside, self._find_owner = door, inside, find_owner
        self._late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:  # type: ignore[override]
        """Begin a connection, whose TLS handshake is over."""
        super().connection_made(transport)
        self._door.let_in(transport.get_extra_info("socket"))
        tls = transport.get_extra_info("ssl_object")
        certificate = tls.getpeercert(binary_form=True) if tls is not None else None
        self.app_state = {**self.app_state, CERTIFICATE: certificate, CONNECTION: ClientConnection(transport)}
        self._inside[self] = self._find_owner(certificate)
        if (odd := find_superfluous(self._inside, OF_EACH, IN_ALL)) is not None:
            del self._inside[odd]
            odd.transport.abort()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """End a connection."""
        self._inside.pop(self, None)
        if self._late is not None:
            self._late.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take data in pieces: a header is held to its limit before more of it is looked at."""
        for start in range(0, len(data), LARGEST_HEADER):
            if not self.transport.is_closing():
                super().data_received(data[start : start + LARGEST_HEADER])

    def handle_events(self) -> None:
        """Handle what has come."""
        super().handle_events()
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for another request."""
        super().on_response_complete()
        self._watch()

    def _watch(self) -> None:
        """Have the connection closed unless a whole header comes in time; not while a request is being answered."""
        answering = self.cycle is not None and not self.cycle.response_complete
        if answering and self._late is not None:
            self._late.cancel()
            self._late = None
        elif not answering and self._late is None:
            self._late = self.loop.call_later(HEADER_S, self.transport.abort)


class PatientLoop(asyncio.SelectorEventLoop):
    """Event loop whose servers do not wait for clients that leave TLS's handshake, or its end, open."""

    async def create_server(self, *args: Any, **more: Any) -> asyncio.Server:  # type: ignore[override]
        """Create a server with these limits."""
        limits = {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": CLOSE_S}
        return await super().create_server(*args, **more, **limits)


class DoorServer(uvicorn.Server):
    """Server that listens at a door."""

    def __init__(self, config: uvicorn.Config, door: Door) -> None:
        super().__init__(config)
        self._door = door

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until the process gets a signal to end."""
        super().run([self._door, *(sockets or [])])


def serve_https(
    app: ASGIApp,
    host: str,
    port: int,
    certificate: Path,
    key: Path,
    authority: Path | None = None,
    find_owner: Callable[[bytes | None], Hashable] = lambda _: "",
) -> uvicorn.Server:
    """Return a server of `app`, to be run; `authority`: of the certificates without which no client is let in.

    find_owner: returns whose certificate (DER) one is; an owner may have `OF_EACH` connections.
    """
    sslproto.SSLProtocol.max_size = BUFFER
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(FILES, hard)), hard))
    door = open_door(host, port)
    config = uvicorn.Config(
        app,
        http=partial(CertifiedProtocol, door=door, inside={}, find_owner=find_owner),  # type: ignore[arg-type]
        h11_max_incomplete_event_size=LARGEST_HEADER,
        ws="none",
        loop=f"{__name__}:{PatientLoop.__name__}",
        lifespan="on",
        log_level="error",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        backlog=BACKLOG,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        ssl_ca_certs=None if authority is None else str(authority),
        ssl_cert_reqs=ssl.CERT_NONE if authority is None else ssl.CERT_REQUIRED,
        timeout_keep_alive=int(HEADER_S),  # longer than httpx keeps a connection, which so ends it first
        timeout_graceful_shutdown=2,
    )
    config.load()
    assert config.ssl is not None
    config.ssl.minimum_version = ssl.TLSVersion.TLSv1_3
    return DoorServer(config, door)


def open_door(host: str, port: int) -> Door:
    """Return the listening socket of an address; raises `OSError` where it is in use."""
    kind = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.getaddrinfo(host, port, kind, socket.SOCK_STREAM)[0]
    door = Door(found[0], found[1], found[2])
    door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    door.bind(found[4])
    return door
