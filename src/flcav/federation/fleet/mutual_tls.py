"""Mutual TLS: a uvicorn server that passes the client certificate of each request to its app.

`scope["state"]` of a request has the client's certificate (DER; None: it has none) and its connection, whose bytes are
read where they cross: the kernel counts those of a TCP socket (TCP_INFO, Linux), TLS records included.
"""

import socket
import ssl
import struct
from pathlib import Path
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

CERTIFICATE, CONNECTION = "certificate", "connection"  # keys of the state
RECEIVED_AT, SENT_AT, INFO_BYTES = 128, 200, 216  # tcpi_bytes_received, tcpi_bytes_sent and _retrans in linux/tcp.h


class Connection:
    """A client's connection, and how many of its bytes were counted already."""

    def __init__(self, transport: Any) -> None:
        self._socket = transport.get_extra_info("socket")
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


class CertifiedProtocol(HttpToolsProtocol):
    """HTTP/1.1 of uvicorn, with the client's certificate and connection in the state of each request."""

    def connection_made(self, transport: Any) -> None:  # type: ignore[override]
        """Begin a connection, whose TLS handshake is over."""
        super().connection_made(transport)
        tls = transport.get_extra_info("ssl_object")
        certificate = tls.getpeercert(binary_form=True) if tls is not None else None
        self.app_state = {**self.app_state, CERTIFICATE: certificate, CONNECTION: Connection(transport)}


def serve_https(
    app: ASGIApp, host: str, port: int, certificate: Path, key: Path, authority: Path | None = None
) -> uvicorn.Server:
    """Return a server of `app`, to be run; `authority`: of the certificates without which no client is let in."""
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        http=CertifiedProtocol,
        loop="asyncio",
        lifespan="on",
        log_level="warning",
        log_config=None,
        access_log=False,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        ssl_ca_certs=None if authority is None else str(authority),
        ssl_cert_reqs=ssl.CERT_NONE if authority is None else ssl.CERT_REQUIRED,
        timeout_graceful_shutdown=2,
    )
    config.load()
    assert config.ssl is not None
    config.ssl.minimum_version = ssl.TLSVersion.TLSv1_3
    return uvicorn.Server(config)
