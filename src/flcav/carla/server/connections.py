"""Connections of clients: parsing of calls, limits on a server's resources, and subscribers of streams.

If unfinished calls exceed their total limit, the connection with the largest one is closed; a full server closes the
connection that has been idle longest; slow readers are awaited together, and dropped if they stay behind.
"""

import asyncio
import logging
import socket
import struct
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import msgpack

from flcav.carla.server.wire import WireError

STUCK_S = 10.0  # time after which a reader that is behind is dropped
MOST_CONNECTIONS = 512
IDLE_S = 10.0  # a full server keeps connections that were used within this time
MOST_UNFINISHED = 64 << 20  # bytes of incomplete calls, of all connections
MOST_UNSENT = 1 << 30  # bytes in the send buffers of all connections
LARGEST = 32 << 20  # bytes of a call; the text of a map is the largest
MOST_ARRAYS = 200_000  # in one call

BACKLOG = 1 << 20  # bytes in a connection's send buffer from which its reader is awaited

log = logging.getLogger("flcav.carla")


class Connections:
    """The connections of all clients."""

    def __init__(self) -> None:
        self._active: dict[asyncio.StreamWriter, float] = {}  # connection -> time of its last use
        self._unfinished: dict[asyncio.StreamWriter, int] = {}  # bytes of incomplete calls
        self._streams: dict[int, set[asyncio.StreamWriter]] = {}
        self._told: set[str] = set()  # keys of refusals that were logged

    def tell(self, key: str, message: str) -> None:
        """Log a refusal, once per key."""
        if key not in self._told and len(self._told) < 1000:
            self._told.add(key)
            log.warning("refused: %s", message[:300])

    def admit(self, writer: asyncio.StreamWriter) -> bool:
        """Register a connection; return False, and close it, if the server is full."""
        if len(self._active) >= MOST_CONNECTIONS:
            idlest = min(self._active, key=self._active.__getitem__)
            if time.monotonic() - self._active[idlest] < IDLE_S:
                self.tell("full", f"one more than {MOST_CONNECTIONS} connections")
                writer.close()
                return False
            self.tell("idle", f"one more than {MOST_CONNECTIONS} connections: the one that was idle longest is closed")
            self._drop(idlest)
        self.note_active(writer)
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # asyncio may not
        return True

    def listen(self, writer: asyncio.StreamWriter, stream: int) -> None:
        """Subscribe a connection to a stream."""
        self._streams.setdefault(stream, set()).add(writer)

    def note_active(self, writer: asyncio.StreamWriter) -> None:
        """Record that a connection is in use."""
        self._active[writer] = time.monotonic()

    def _drop(self, writer: asyncio.StreamWriter) -> None:
        writer.transport.abort()
        self.forget(writer)

    def forget(self, writer: asyncio.StreamWriter) -> None:
        """Close a connection and unsubscribe it from all streams."""
        self._active.pop(writer, None)
        self._unfinished.pop(writer, None)
        for stream in [stream for stream, writers in self._streams.items() if writer in writers]:
            self._streams[stream].discard(writer)
            if not self._streams[stream]:
                del self._streams[stream]
        writer.close()

    def note_unfinished(self, writer: asyncio.StreamWriter, size: int) -> None:
        """Record the bytes of a connection's incomplete call; close the largest while all together are too many."""
        self._unfinished[writer] = size
        while sum(self._unfinished.values()) > MOST_UNFINISHED:
            largest = max(self._unfinished, key=self._unfinished.__getitem__)
            self.tell("unfinished", f"unfinished calls of more than {MOST_UNFINISHED} bytes")
            self._drop(largest)

    def is_heard(self, stream: int) -> bool:
        """Return whether a stream has a subscriber."""
        return bool(self._streams.get(stream))

    async def await_readers(self, writers: Iterable[asyncio.StreamWriter] | None = None) -> None:
        """Wait until all slow readers, or those of `writers`, have caught up; drop them after `STUCK_S`."""
        drains = {
            asyncio.ensure_future(writer_behind.drain()): writer_behind
            for writer_behind in writers or list(self._active)
            if _unsent(writer_behind) > BACKLOG
        }
        if not drains:
            return
        _, late = await asyncio.wait(drains, timeout=STUCK_S)
        for drain, writer in drains.items():
            if drain in late:
                drain.cancel()
                log.warning("a client reads no more: its connection is closed")
            if drain in late or drain.exception() is not None:
                self._drop(writer)

    async def publish(self, stream: int, payload: bytes) -> None:
        """Send a payload to all subscribers of a stream; wait for readers if too much is unsent."""
        unsent = sum(map(_unsent, self._active))
        for writer in list(self._streams.get(stream, ())):
            unsent += len(payload)
            if unsent > MOST_UNSENT:
                await self.await_readers()
                unsent = sum(map(_unsent, self._active)) + len(payload)
            if writer in self._active:  # it was not dropped meanwhile
                send_payload(writer, payload)
                self.note_active(writer)

    async def close(self) -> None:
        """Close all connections, and wait until their readers have ended."""
        for writer in self._active:
            writer.transport.abort()
        while self._active:
            await asyncio.sleep(0.001)


def _unsent(writer: asyncio.StreamWriter) -> int:
    return writer.transport.get_write_buffer_size()


def send_payload(writer: asyncio.StreamWriter, payload: bytes) -> None:
    """Send a payload of a stream, prefixed by its length."""
    write(writer, struct.pack("<I", len(payload)) + payload)


def write(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Send bytes if the client is still connected."""
    with suppress(ConnectionError, RuntimeError):
        writer.write(data)


class Unpacker:
    """An incremental parser of one connection's calls: feed it bytes, and iterate over complete calls.

    Of an incomplete call only the bytes are kept, and counted by `waiting`; values are created once it is complete, so
    that a client cannot make the server hold large nested values. Iteration raises `WireError` or `ValueError`.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()  # of calls that are not parsed yet
        self._begun = 0  # offset of the first of them in the whole input
        self._skipper = msgpack.Unpacker(max_buffer_size=LARGEST)  # finds the ends of calls

    @property
    def waiting(self) -> int:
        """The number of bytes of calls that are not parsed yet."""
        return len(self._bytes)

    def feed(self, data: bytes) -> None:
        """Add bytes. Raises `WireError` for a call beyond `LARGEST`."""
        if len(self._bytes) + len(data) > LARGEST:
            raise WireError(f"a call of more than {LARGEST} bytes")
        self._bytes += data
        self._skipper.feed(data)

    def __iter__(self) -> "Unpacker":
        return self

    def __next__(self) -> Any:
        try:
            self._skipper.skip()
        except msgpack.OutOfData:
            raise StopIteration from None
        end = self._skipper.tell() - self._begun
        call = bytes(self._bytes[:end])
        del self._bytes[:end]
        self._begun += end
        return _unpack(call)


def _unpack(call: bytes) -> Any:
    """Return the value of a complete call, with bounded memory."""
    arrays = 0

    def count(values: list[Any]) -> list[Any]:
        nonlocal arrays
        arrays += 1
        if arrays > MOST_ARRAYS:
            raise WireError(f"a call of more than {MOST_ARRAYS} arrays")
        return values

    return msgpack.unpackb(
        call,
        raw=False,
        strict_map_key=False,
        max_array_len=MOST_ARRAYS,
        max_map_len=0,
        unicode_errors="surrogateescape",
        list_hook=count,
    )
