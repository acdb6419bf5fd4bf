"""Relay of calls of Flower's nodes to another server, and responses with a sentence or a file (ASGI).

Flower reads the first of repeated headers, and trusts the node id in a body. A vehicle's request is therefore never
passed on verbatim: it is rebuilt from the headers in `SENT`, once each, with the public key of the registry, and from
the parsed body, whose node must be that of the certificate.
"""

import asyncio
import os
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx
from flwr.proto.fab_pb2 import GetFabRequest
from flwr.proto.fleet_pb2 import (
    ActivateNodeRequest,
    DeactivateNodeRequest,
    PullMessagesRequest,
    PushMessagesRequest,
)
from flwr.proto.heartbeat_pb2 import SendNodeHeartbeatRequest
from flwr.proto.message_pb2 import ConfirmMessageReceivedRequest, PullObjectRequest, PushObjectRequest
from flwr.proto.run_pb2 import GetRunRequest
from google.protobuf.message import DecodeError, Message
from starlette.types import Receive, Scope, Send

from flcav.fleet.keys import public_pem
from flcav.fleet.registry import RegisteredVehicle

FLEET = "/v1/fleet/"
CALLS: Mapping[str, type[Message]] = {
    "activate-node": ActivateNodeRequest,
    "deactivate-node": DeactivateNodeRequest,
    "send-node-heartbeat": SendNodeHeartbeatRequest,
    "pull-messages": PullMessagesRequest,
    "push-messages": PushMessagesRequest,
    "get-run": GetRunRequest,
    "get-fab": GetFabRequest,
    "push-object": PushObjectRequest,
    "pull-object": PullObjectRequest,
    "confirm-message-received": ConfirmMessageReceivedRequest,
}  # calls of a node; only the authority may register nodes
NODE_KEY = b"flwr-public-key"  # PEM in base 64
SIGNED_AT = b"flwr-timestamp"  # time of the node's signature
SENT = (SIGNED_AT, b"flwr-signature", b"flwr-package-name", b"flwr-package-version", b"flwr-component-name")
PROTOBUF = ((b"content-type", b"application/protobuf"), (b"accept", b"application/protobuf"))
VALUE = re.compile(rb"[!-~](?:[ -~]{0,510}[!-~])?")  # value of a header
MOST_HEADERS = 40
LONGEST_NAME = 200  # characters of an identifier in a body
LARGEST_OBJECT, LARGEST_CALL = 16_000_000, 4_000_000  # bytes of a body; Flower cuts arrays into pieces of 5 MiB

HOP_BY_HOP = {b"connection", b"keep-alive", b"transfer-encoding", b"te", b"trailer", b"upgrade", b"host"}  # RFC 9110
PIECE_BYTES = 1 << 18  # piece of a file that is sent at a time
TIMEOUT = httpx.Timeout(60.0, connect=5.0)
QUIET_S, BODY_S = 20.0, 300.0  # timeouts of a body: between two pieces, and in total [s]

Headers = Sequence[tuple[bytes, bytes]]


class RelayRefused(Exception):
    """The refusal of a request, with an HTTP status and a sentence."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status, self.why = status, why


@dataclass
class Relayed:
    """The result of one relayed exchange: sizes of the bodies [bytes] and status."""

    up: int = 0
    down: int = 0
    status: int = 0  # of the response; 0: there was none


async def answer(send: Send, status: int, text: str) -> None:
    """Send a response with one sentence as its body."""
    body = text.encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def send_file(send: Send, path: Path, sent: Callable[[], object]) -> None:
    """Send a file as a response with a content length; `sent` is called after every piece."""
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        headers = [(b"content-type", b"application/octet-stream"), (b"content-length", str(left).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        more = True
        while more:
            piece = await asyncio.to_thread(file.read, min(left, PIECE_BYTES))
            left -= len(piece)
            more = left > 0 and bool(piece)  # a truncated file ends short of its length: the call breaks
            await send({"type": "http.response.body", "body": piece, "more_body": more})
            sent()


async def read_body(scope: Scope, receive: Receive, most: int) -> bytes:
    """Return the body of a request.

    Raises `RelayRefused` where it is longer than `most` bytes, pauses for more than `QUIET_S`, takes more than
    `BODY_S`, or is interrupted.
    """
    declared = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
    if int(declared) > most:
        raise RelayRefused(400, f"the message has more than {most} bytes")
    body = bytearray()
    more = True
    try:
        async with asyncio.timeout(BODY_S):
            while more:
                async with asyncio.timeout(QUIET_S):
                    event = await receive()
                if event["type"] == "http.disconnect":
                    raise RelayRefused(400, "the client has left")
                body += event.get("body", b"")
                if len(body) > most:
                    raise RelayRefused(400, f"the message has more than {most} bytes")
                more = event.get("more_body", False)
    except TimeoutError:
        raise RelayRefused(408, "the message does not come") from None
    return bytes(body)


def check_headers(headers: Headers) -> dict[bytes, bytes]:
    """Return headers by lower-case name; raises `RelayRefused` for repeated headers, or a body of unknown length."""
    if len(headers) > MOST_HEADERS:
        raise RelayRefused(431, f"more than {MOST_HEADERS} headers")
    name, count = Counter(name.lower() for name, _ in headers).most_common(1)[0] if headers else (b"", 0)
    if count > 1:
        raise RelayRefused(400, f"the header {name.decode('latin-1')} comes {count} times")
    found = {name.lower(): value for name, value in headers}
    if b"transfer-encoding" in found:
        raise RelayRefused(411, "the length of the body is wanted before it")
    return found


def largest_body(call: str) -> int:
    """Return the size limit of a call's body [bytes]."""
    return LARGEST_OBJECT if call == "push-object" else LARGEST_CALL


def choose_headers(headers: Mapping[bytes, bytes], names: Iterable[bytes] = SENT) -> list[tuple[bytes, bytes]]:
    """Return the headers to pass on, out of `names`; raises `RelayRefused` for a value that is not plain ASCII."""
    if headers.get(b"content-type", b"") != PROTOBUF[0][1]:
        raise RelayRefused(415, "a body of another type than application/protobuf")
    chosen = [(name, headers[name]) for name in names if name in headers]
    for name, value in chosen:
        if not VALUE.fullmatch(value):
            raise RelayRefused(400, f"the header {name.decode()} is no plain text, or too long")
    return [*PROTOBUF, *chosen]


def name_key(vehicle: RegisteredVehicle) -> tuple[bytes, bytes]:
    """Return Flower's header with a vehicle's registered key."""
    return NODE_KEY, b64encode(public_pem(vehicle.public_key))


def check_body(call: str, body: bytes, vehicle: RegisteredVehicle) -> bytes:
    """Return the body of a vehicle's call, parsed and serialised again.

    Raises `RelayRefused` where it is not of that call, or names another vehicle's node or key.
    """
    try:
        message_ = CALLS[call].FromString(body)
    except DecodeError:
        raise RelayRefused(400, f"the body is none of {call}") from None
    # fields unknown here might be known to another version of Flower behind the proxy
    message_.DiscardUnknownFields()
    _check_texts(message_)
    if isinstance(message_, ActivateNodeRequest):
        if message_.public_key != public_pem(vehicle.public_key):
            raise RelayRefused(401, "the key to activate is not the certificate's")
        return message_.SerializeToString()
    if vehicle.node is None:
        raise RelayRefused(503, "the vehicle is being enrolled")
    node = message_ if isinstance(message_, DeactivateNodeRequest) else message_.node  # type: ignore[attr-defined]
    named = {node.node_id}
    if isinstance(message_, PushMessagesRequest):
        for message in message_.messages_list:
            _check_texts(message.metadata)
            named.add(message.metadata.src_node_id)
    if named != {vehicle.node}:
        raise RelayRefused(401, "the node in the body is not the certificate's")
    return message_.SerializeToString()


def _check_texts(message: Message) -> None:
    """Refuse unprintable or long identifiers, which Flower would write to its log."""
    for field, value in message.ListFields():
        texts = [value] if isinstance(value, str) else value if field.type == field.TYPE_STRING else ()
        if not all(text.isprintable() and len(text) <= LONGEST_NAME for text in texts):
            raise RelayRefused(400, f"{field.name} is no identifier")


async def relay(client: httpx.AsyncClient, path: str, headers: Headers, body: bytes, send: Send) -> Relayed:
    """Pass a POST request on by `client`, whose base URL is that of the other server; return the result.

    If the other server cannot be reached, the response is 503, after which Flower's nodes try again.
    """
    done = Relayed(up=len(body))
    begun = False
    try:
        request = client.build_request("POST", path, headers=[*headers], content=body)
        for name in ("accept-encoding", "user-agent"):  # added by httpx
            request.headers.pop(name, None)
        response = await client.send(request, stream=True)
        try:
            kept = [(name.lower(), value) for name, value in response.headers.raw if name.lower() not in HOP_BY_HOP]
            await send({"type": "http.response.start", "status": response.status_code, "headers": kept})
            begun = True
            async for piece in response.aiter_raw():
                done.down += len(piece)
                await send({"type": "http.response.body", "body": piece, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
            done.status = response.status_code
        finally:
            await response.aclose()
    except httpx.TransportError as error:
        if begun:
            raise
        await answer(send, 503, f"the next server is not there: {error}")
    return done


async def keep_alive(receive: Receive, send: Send) -> bool:
    """Handle an event of the server's lifespan; return whether that has ended."""
    event = await receive()
    await send({"type": f"{event['type']}.complete"})
    return event["type"] == "lifespan.shutdown"
