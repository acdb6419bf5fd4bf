"""Calls out of the bytes of a connection: MessagePack values that follow each other without a length."""

from typing import Any

import msgpack

from flcav.sources.carla.server.wire import WireError

LARGEST = 32 << 20  # bytes of a call; the text of a map is the largest
MOST_ARRAYS = 200_000  # in one call


class Unpacker:
    """Reads the calls of one connection: feed it bytes, and iterate; `WireError` and `ValueError` end it.

    Of an unfinished call it keeps the bytes alone; `waiting` tells how many. Values are made of whole calls.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()  # of the calls that are not yet read
        self._begun = 0  # place of the first of them in all that was fed
        self._skipper = msgpack.Unpacker(max_buffer_size=LARGEST)  # finds where calls end

    @property
    def waiting(self) -> int:
        """The number of bytes that belong to calls which are not yet read."""
        return len(self._bytes)

    def feed(self, data: bytes) -> None:
        """Add bytes; raises `WireError` for a call beyond `LARGEST`."""
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
    """Return the value of a whole call, within bounds of its memory."""
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
