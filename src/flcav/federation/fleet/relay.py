"""Relaying of HTTP requests to another server, and answers with a sentence or a file (ASGI)."""

import asyncio
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import httpx
from starlette.types import Receive, Scope, Send

HOP_BY_HOP = {b"connection", b"keep-alive", b"transfer-encoding", b"te", b"trailer", b"upgrade", b"host"}  # RFC 9110
PIECE_BYTES = 1 << 18  # of a file
TIMEOUT = httpx.Timeout(60.0, connect=5.0)
QUIET_S, BODY_S = 20.0, 300.0  # that a body may pause, and take in all


class Refused(Exception):
    """A request is refused with an HTTP status and a sentence."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status, self.why = status, why


@dataclass
class Relayed:
    """Sizes of the bodies of one exchange [bytes], and its answer."""

    up: int = 0
    down: int = 0
    status: int = 0  # of the answer; 0: the other server gave none


async def answer(send: Send, status: int, text: str) -> None:
    """Send a response of one sentence."""
    body = text.encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def send_file(send: Send, path: Path, sent: Callable[[], object]) -> None:
    """Send a file as a response, with its size at the beginning; `sent` is called after each piece."""
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        headers = [(b"content-type", b"application/octet-stream"), (b"content-length", str(left).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        more = True
        while more:
            piece = await asyncio.to_thread(file.read, min(left, PIECE_BYTES))
            left -= len(piece)
            more = left > 0 and bool(piece)  # of a file that was cut, less than its size is sent, which breaks the call
            await send({"type": "http.response.body", "body": piece, "more_body": more})
            sent()


async def read_body(scope: Scope, receive: Receive, most: int) -> bytes:
    """Return the body of a request.

    Raises `Refused` where it is longer than `most` bytes, pauses for more than `QUIET_S`, takes more than `BODY_S`, or
    breaks off.
    """
    told = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
    if int(told) > most:
        raise Refused(400, f"the message has more than {most} bytes")
    body, more = bytearray(), True
    try:
        async with asyncio.timeout(BODY_S):
            while more:
                async with asyncio.timeout(QUIET_S):
                    event = await receive()
                if event["type"] == "http.disconnect":
                    raise Refused(400, "the client has left")
                body += event.get("body", b"")
                if len(body) > most:
                    raise Refused(400, f"the message has more than {most} bytes")
                more = event.get("more_body", False)
    except TimeoutError:
        raise Refused(408, "the message does not come") from None
    return bytes(body)


async def relay(
    client: httpx.AsyncClient, path: str, headers: Iterable[tuple[bytes, bytes]], body: bytes, send: Send
) -> Relayed:
    """Pass a POST request on by `client`, whose base address is the other server's; return the sizes.

    Where the other server cannot be reached, the answer is 503, after which Flower's nodes try again.
    """
    done, begun = Relayed(up=len(body)), False
    try:
        request = client.build_request("POST", path, headers=[*headers], content=body)
        for name in ("accept-encoding", "user-agent"):  # httpx's own
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
    """Handle an event of the server's lifespan; return whether it has ended."""
    event = await receive()
    await send({"type": f"{event['type']}.complete"})
    return event["type"] == "lifespan.shutdown"
