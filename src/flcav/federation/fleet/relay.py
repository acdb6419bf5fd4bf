"""Relaying of HTTP requests to another server, and answers with a sentence or a file (ASGI)."""

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

import httpx
from starlette.types import Message, Receive, Scope, Send

HOP_BY_HOP = {b"connection", b"keep-alive", b"transfer-encoding", b"te", b"trailer", b"upgrade", b"host"}  # RFC 9110
LARGEST_BODY = 64_000_000  # bytes; Flower's objects have 5 MiB at most
PIECE_BYTES = 1 << 18  # of a file
TIMEOUT = httpx.Timeout(60.0, connect=5.0)


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


async def read_body(receive: Receive, most: int) -> bytes:
    """Return the body of a request; raises ValueError where it is longer than `most` bytes, or breaks off."""
    body, more = b"", True
    while more:
        event = await receive()
        if event["type"] == "http.disconnect":
            raise ValueError("the client has left")
        body += event.get("body", b"")
        if len(body) > most:
            raise ValueError(f"the message has more than {most} bytes")
        more = event.get("more_body", False)
    return body


async def relay(client: httpx.AsyncClient, scope: Scope, receive: Receive, send: Send) -> Relayed:
    """Pass a request on by `client`, whose base address is the other server's; return the sizes.

    Where the other server cannot be reached, the answer is 503, after which Flower's nodes try again.
    """
    done = Relayed()

    async def body() -> AsyncIterator[bytes]:
        more = True
        while more:
            event: Message = await receive()
            if event["type"] == "http.disconnect":
                raise httpx.ReadError("the client has left")
            done.up += len(event.get("body", b""))
            if done.up > LARGEST_BODY:
                raise httpx.ReadError("the body is too large")
            yield event.get("body", b"")
            more = event.get("more_body", False)

    headers = [(name, value) for name, value in scope["headers"] if name.lower() not in HOP_BY_HOP]
    target = scope["raw_path"].decode("ascii")
    begun = False
    try:
        request = client.build_request(scope["method"], target, headers=headers, content=body())
        for name in ("accept-encoding", "user-agent", "accept"):  # httpx's own, where the caller has none
            if name.encode() not in {key.lower() for key, _ in scope["headers"]}:
                request.headers.pop(name, None)
        if "content-length" in request.headers:
            request.headers.pop("transfer-encoding", None)
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
