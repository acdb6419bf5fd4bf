"""Mutual TLS: a uvicorn server that passes the client's certificate to its app, with limits on connections.

`scope["state"]` of a request has the client's certificate (DER; None: it has none) and its connection. Bytes are those
that the kernel counts on the TCP socket (TCP_INFO, Linux), TLS records included.

A connection without a complete request is closed after some seconds; where there are too many, the oldest connection of
the client with most is closed, so that idle connections cannot lock other clients out.
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
HANDSHAKES, OF_EACH, IN_ALL = 256, 16, 768  # limits of connections: in handshake; per client; all after handshake
FILES = 4096  # limit of open files, if the system allows it: these connections, and as many to the next server
BACKLOG = 128  # connections that the kernel queues until they are accepted
HANDSHAKE_S, HEADER_S, CLOSE_S = 10.0, 10.0, 2.0  # timeouts of TLS's handshake, a request's header, TLS's closing [s]
LARGEST_HEADER = 8192  # bytes
SWEPT = 256  # connections between garbage collections, which asyncio's TLS needs, as its objects form cycles
BUFFER = 1 << 15  # initial buffer of a connection in asyncio's TLS [bytes], in place of 256 KiB

Key = TypeVar("Key")


class ClientConnection:
    """A client's connection, with its bytes counted so far."""

    def __init__(self, transport: Any) -> None:
        self._socket = transport.get_extra_info("socket")
        self.abort = transport.abort
        self.is_closed = transport.is_closing
        self._counted = (0, 0)

    def count_bytes(self) -> tuple[int, int]:
        """Return the bytes received and sent since the last call; zeros if the system does not report them."""
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
        # the kernel counts retransmitted bytes as sent, and an application did not send them
        before, self._counted = self._counted, (received, sent - again)
        return received - before[0], sent - again - before[1]


def find_superfluous(owners: Mapping[Key, Hashable], of_each: int, most: int) -> Key | None:
    """Return the connection to close, the oldest of the client with most; None if there are not too many.

    owners: client by connection, oldest first. of_each: limit per client. most: limit of all.
    """
    counts = Counter(owners.values()).most_common(1)
    if not counts or (counts[0][1] <= of_each and len(owners) <= most):
        return None
    return next(key for key, owner in owners.items() if owner == counts[0][0])


class Door(socket.socket):
    """A listening socket that limits the TCP connections in TLS handshake."""

    def __init__(self, *about: Any) -> None:
        super().__init__(*about)
        self._accepted: dict[int, tuple[socket.socket, str]] = {}  # connection and address, by file descriptor
        self._count = 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; where there are too many, shut one down, which ends its handshake."""
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
        """Remove a connection whose handshake is complete."""
        self._accepted.pop(connection.fileno(), None)


class CertifiedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 protocol, with the client's certificate and connection in the state of requests."""

    def __init__(
        self,
        *args: Any,
        door: Door,
        inside: dict["CertifiedProtocol", Hashable],
        find_owner: Callable[[bytes | None], Hashable],
        **more: Any,
    ) -> None:
        """Register in `inside`, owner by connection; `find_owner` returns the owner of a certificate (DER)."""
        super().__init__(*args, **more)
        self._door, self._inside, self._find_owner = door, inside, find_owner
        self._late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:  # type: ignore[override]
        """Begin a connection after its TLS handshake."""
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
        """Process data in pieces, so that a header is checked against its limit before more of it is parsed."""
        for start in range(0, len(data), LARGEST_HEADER):
            if not self.transport.is_closing():
                super().data_received(data[start : start + LARGEST_HEADER])

    def handle_events(self) -> None:
        """Handle the received events."""
        super().handle_events()
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def _watch(self) -> None:
        """Close the connection unless a complete header arrives in time; not while a request is being answered."""
        answering = self.cycle is not None and not self.cycle.response_complete
        if answering and self._late is not None:
            self._late.cancel()
            self._late = None
        elif not answering and self._late is None:
            self._late = self.loop.call_later(HEADER_S, self.transport.abort)


class PatientLoop(asyncio.SelectorEventLoop):
    """An event loop whose servers time out clients that do not complete TLS's handshake or closing."""

    async def create_server(self, *args: Any, **more: Any) -> asyncio.Server:  # type: ignore[override]
        """Create a server with these limits."""
        limits = {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": CLOSE_S}
        return await super().create_server(*args, **more, **limits)


class DoorServer(uvicorn.Server):
    """A uvicorn server that listens on a `Door`."""

    def __init__(self, config: uvicorn.Config, door: Door) -> None:
        super().__init__(config)
        self._door = door

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until the process receives a signal to end."""
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
    """Return a server of `app`, to be run.

    authority: its certificates are required of clients; None: none are. find_owner: returns the owner of a certificate
    (DER); an owner may have `OF_EACH` connections.
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
        timeout_keep_alive=int(HEADER_S),  # longer than httpx's, so that the client closes first
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
