"""Communication ledger: the bytes of every message on every link, under uplink budgets that it enforces.

Messages on a link: serialisation of arrays, and sending through a ledger. A message is a safetensors file: names, types
and shapes of its arrays in JSON, then their values; nothing is unpickled.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from safetensors.numpy import load, save

from flcav.arrays import Bytes, Words
from flcav.config import InputError
from flcav.storage.files import read_parquet, write_parquet

Link = Literal["wireless", "wireline", "sidelink"]
Direction = Literal["up", "down"]

LINKS: tuple[Link, ...] = ("wireless", "wireline")  # with a budget; from vehicle to vehicle there is none
BYTES_PER_MB = 1_000_000


class BudgetExceeded(InputError):
    """Raised for an uplink message that is larger than the remaining budget of its link."""


@dataclass(frozen=True)
class LinkMegabytes:
    """Megabytes on each uplink: a budget, a price, or the traffic sent [MB; 1 MB = 10^6 bytes]."""

    wireless_mb: float  # from vehicles to edge servers
    wireline_mb: float  # from edge servers to the cloud

    def bytes_on(self, link: Link) -> int:
        """Return the bytes on `link`, rounded to a whole number."""
        return round((self.wireless_mb if link == "wireless" else self.wireline_mb) * BYTES_PER_MB)


@dataclass(frozen=True)
class LedgerEntry:
    """One message on one link.

    Raises ValueError for an unknown link or direction, or a negative size.
    """

    stage: str  # pretrain | edge | cloud
    task: str  # e.g. "objects"
    link: Link
    direction: Direction  # up: towards the cloud; only this counts against a budget
    round: int  # within its stage, from 1; 0 where a stage has no rounds
    client: str  # sender (up) or receiver (down), e.g. "grid/cav0"
    bytes: int  # serialised size

    def __post_init__(self) -> None:
        if self.link not in get_args(Link):
            raise ValueError(f"LedgerEntry.link = {self.link!r}, expected one of {get_args(Link)}")
        if self.direction not in get_args(Direction):
            raise ValueError(f"LedgerEntry.direction = {self.direction!r}, expected one of {get_args(Direction)}")
        if self.bytes < 0:
            raise ValueError(f"LedgerEntry.bytes = {self.bytes}, expected at least 0")


_SCHEMA = pa.schema([(field.name, pa.int64() if field.type is int else pa.string()) for field in fields(LedgerEntry)])


class Ledger:
    """The ledger of one run: its uplink budget and the messages entered so far.

    >>> from flcav import Ledger
    >>> from flcav.network import LinkMegabytes, LedgerEntry
    >>> ledger = Ledger(LinkMegabytes(wireless_mb=2.0, wireline_mb=0.0))
    >>> update = LedgerEntry("edge", "objects", "wireless", "up", round=1, client="grid/cav0", bytes=1_300_000)
    >>> ledger.enter(update)
    >>> ledger.left_mb("wireless")
    0.7
    >>> ledger.enter(update)
    Traceback (most recent call last):
    flcav.network.ledger.BudgetExceeded: wireless uplink budget exceeded: ...
    """

    def __init__(self, budget: LinkMegabytes, entries: Iterable[LedgerEntry] = ()) -> None:
        """Enter `entries` in order; raises `BudgetExceeded` at the first that does not fit."""
        self.budget = budget
        self._entries: list[LedgerEntry] = []
        self._up = dict.fromkeys(LINKS, 0)
        for entry in entries:
            self.enter(entry)

    def __iter__(self) -> Iterator[LedgerEntry]:
        return iter(self._entries)

    @property
    def entries(self) -> tuple[LedgerEntry, ...]:
        """Return all entries in the order in which they were entered."""
        return tuple(self._entries)

    def check(self, entry: LedgerEntry) -> None:
        """Raise `BudgetExceeded` if `entry` is an uplink message over the budget."""
        if entry.direction == "up" and entry.link in LINKS:
            used = self._up[entry.link]
            budget = self.budget.bytes_on(entry.link)
            if used + entry.bytes > budget:
                raise BudgetExceeded(
                    f"{entry.link} uplink budget exceeded: {entry.client} wants {_mb(entry.bytes)} MB for round "
                    f"{entry.round} of stage {entry.stage!r} of {entry.task!r}, but {_mb(used)} of the "
                    f"{_mb(budget)} MB are spent"
                )

    def enter(self, entry: LedgerEntry) -> None:
        """Append `entry`; raises `BudgetExceeded` and appends nothing if it is an uplink message over the budget."""
        self.check(entry)
        if entry.direction == "up" and entry.link in LINKS:
            self._up[entry.link] += entry.bytes
        self._entries.append(entry)

    def left_mb(self, link: Link) -> float:
        """Return the unspent part of the uplink budget of `link` [MB]."""
        return (self.budget.bytes_on(link) - self._up[link]) / BYTES_PER_MB

    def used_bytes(
        self,
        link: Link | None = None,
        *,
        stage: str | None = None,
        task: str | None = None,
        direction: Direction = "up",
    ) -> int:
        """Return the bytes of the entries in `direction`, restricted to a `link`, `stage` and `task` unless None."""
        return sum(
            entry.bytes
            for entry in self._entries
            if entry.direction == direction
            and link in (None, entry.link)
            and stage in (None, entry.stage)
            and task in (None, entry.task)
        )

    def used_mb(
        self,
        link: Link | None = None,
        *,
        stage: str | None = None,
        task: str | None = None,
        direction: Direction = "up",
    ) -> float:
        """Return `used_bytes` in MB (10^6 bytes)."""
        return self.used_bytes(link, stage=stage, task=task, direction=direction) / BYTES_PER_MB

    def save(self, path: Path | str) -> None:
        """Write the ledger atomically to a Parquet file: a row per entry, the budget in the schema's metadata."""
        columns = {field.name: [getattr(entry, field.name) for entry in self._entries] for field in fields(LedgerEntry)}
        schema = _SCHEMA.with_metadata({"budget": json.dumps(asdict(self.budget))})
        write_parquet(pa.table(columns, schema=schema), Path(path))

    @classmethod
    def load(cls, path: Path | str) -> "Ledger":
        """Return the ledger that `save` wrote to `path`; raises `InputError` where the file is missing or not one."""
        table = read_parquet(Path(path))
        try:
            budget = LinkMegabytes(**json.loads((table.schema.metadata or {})[b"budget"]))
            return cls(budget, (LedgerEntry(**row) for row in table.to_pylist()))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: not a ledger ({error})") from None


def _mb(count: int) -> str:
    return f"{count / BYTES_PER_MB:.6g}"


Arrays = Mapping[str, NDArray]  # by name


def pack_arrays(arrays: Arrays) -> bytes:
    """Serialise arrays of numbers or booleans as a message."""
    # C order, since safetensors stores the buffer as it is; names are sorted by the library: equal arrays, equal bytes.
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()})


def unpack_arrays(message: bytes) -> dict[str, NDArray]:
    """Return the arrays of a message: the inverse of `pack_arrays`, up to their order."""
    return load(message)


def from_names(names: Iterable[str]) -> Bytes:
    """Return names without line breaks as an array for a message: UTF-8, with a line break after each."""
    return np.frombuffer(bytearray("".join(f"{name}\n" for name in names), "utf-8"), dtype=np.uint8)


def to_names(array: Bytes) -> Words:
    """Return the names (N,) in an array of a message: the inverse of `from_names`."""
    return np.array(array.tobytes().decode("utf-8").split("\n")[:-1], dtype=np.str_)


def carry(message: bytes) -> bytes:
    """Return a message as received at the other end of its link: in a simulation, the same bytes."""
    return message


def send_message(
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
    """Send a message from a client (up) or to a client (down), and return its bytes as received.

    The message is first entered in the ledger (`LedgerEntry`); raises `BudgetExceeded` and sends nothing if it is an
    uplink message over the budget.
    """
    book.enter(LedgerEntry(stage, task, link, direction, round_, client, len(message)))
    return carry(message)
