"""Messages on a link: arrays as bytes and back, and sending them through a ledger.

A message is a safetensors file: names, types and shapes of its arrays in JSON, then their values; nothing is unpickled.
"""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from flcav.network.ledger import Direction, Ledger, LedgerEntry, Link

Arrays = Mapping[str, NDArray]  # by name


def pack(arrays: Arrays) -> bytes:
    """Return arrays of numbers or truth values as a message."""
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()})


def unpack(message: bytes) -> dict[str, NDArray]:
    """Return the arrays of a message: the inverse of `pack`, but for their order."""
    return load(message)


def from_names(names: Iterable[str]) -> NDArray[np.uint8]:
    """Return names without line breaks as an array for a message: UTF-8, each ends with a line break."""
    return np.frombuffer(bytearray("".join(f"{name}\n" for name in names), "utf-8"), dtype=np.uint8)


def to_names(array: NDArray[np.uint8]) -> NDArray[np.str_]:
    """Return the names (N,) in an array of a message: the inverse of `from_names`."""
    return np.array(array.tobytes().decode("utf-8").split("\n")[:-1], dtype=np.str_)


def carry(message: bytes) -> bytes:
    """Return a message as the other end of its link has it; in a simulation, the same bytes."""
    return message


def send(
    book: Ledger,
    message: bytes,
    *,
    stage: str,
    task: str,
    link: Link,
    direction: Direction,
    client: str,
    round_: int = 0,
) -> bytes:
    """Send a message of a client, up, or to it, down; return its bytes as they are received.

    It is entered in the ledger first, see `LedgerEntry`. Raises `BudgetExceeded`, and then nothing is sent.
    """
    book.enter(LedgerEntry(stage, task, link, direction, round_, client, len(message)))
    return carry(message)
