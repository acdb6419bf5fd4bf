"""Records of the clock of rounds: the work of each client, when it did what, and why its update did not arrive."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from flcav.config import InputError
from flcav.network.ledger import LedgerEntry
from flcav.storage.files import read_parquet, write_parquet

_TYPES: dict[Any, pa.DataType] = {str: pa.string(), int: pa.int64(), float: pa.float64()}


@dataclass(frozen=True)
class ClientTiming:
    """The time of one client in one round [s], on the trace's clock."""

    client: str  # e.g. "cav0"
    server: str  # edge server at the start of the round, e.g. "pole3"
    round: int
    start_s: float  # when its edge server begins to send the model
    download_s: float  # duration, as far as it came
    compute_s: float
    upload_s: float
    end_s: float  # its update has arrived, or it was dropped
    downloaded_bytes: int
    uploaded_bytes: int
    dropped: str  # why its update did not arrive, e.g. "left the town"; empty where it did


@dataclass(frozen=True)
class RoundTiming:
    """One round on the trace's clock [s]: wireline download, then the clients, then wireline upload."""

    round: int  # from 1
    start_s: float
    end_s: float
    wireline_down_s: float  # cloud to edge servers; 0 where the round takes no part in that
    wireline_up_s: float  # edge servers to cloud
    clients: tuple[ClientTiming, ...]

    @property
    def finished(self) -> tuple[ClientTiming, ...]:
        """Return the clients whose updates arrived."""
        return tuple(client for client in self.clients if not client.dropped)

    @property
    def straggler(self) -> ClientTiming | None:
        """Return the client whose update arrived last; None where none did."""
        return max(self.finished, key=lambda client: client.end_s, default=None)


_ROUND = tuple(field for field in fields(RoundTiming) if field.name not in ("round", "clients"))
SCHEMA = pa.schema(
    [(field.name, _TYPES[field.type]) for field in fields(ClientTiming)]
    + [(f"round_{field.name}", _TYPES[field.type]) for field in _ROUND]
)


def tabulate_rounds(records: Sequence[RoundTiming]) -> pa.Table:
    """Return a table with a row per client and round; attributes of the round are in the columns `round_...`."""
    rows = [
        {**asdict(client), **{f"round_{field.name}": getattr(record, field.name) for field in _ROUND}}
        for record in records
        for client in record.clients
    ]
    return pa.Table.from_pylist(rows, schema=SCHEMA)


def save_rounds(records: Sequence[RoundTiming], path: Path) -> None:
    """Write `tabulate_rounds` atomically to a Parquet file."""
    write_parquet(tabulate_rounds(records), path)


def load_rounds(path: Path) -> tuple[RoundTiming, ...]:
    """Return the rounds that `save_rounds` wrote; raises `InputError` where the file is missing or holds none."""
    table = read_parquet(path)
    if table.schema.remove_metadata() != SCHEMA:
        raise InputError(f"{path}: not a table of rounds")
    rows: list[dict[str, Any]] = table.to_pylist()
    if any(value is None for row in rows for value in row.values()):
        raise InputError(f"{path}: a table of rounds with an empty field")
    records = []
    for number, group in groupby(rows, key=lambda row: row["round"]):
        own = list(group)
        about = {field.name: own[0][f"round_{field.name}"] for field in _ROUND}
        clients = (ClientTiming(**{field.name: row[field.name] for field in fields(ClientTiming)}) for row in own)
        records.append(RoundTiming(round=number, clients=tuple(clients), **about))
    return tuple(records)


@dataclass(frozen=True)
class ClientWork:
    """The work of a client in a round. Raises `InputError` for a negative number."""

    client: str  # a vehicle of the links
    download_bytes: int  # the model, from its edge server
    compute_s: float
    upload_bytes: int  # its update

    def __post_init__(self) -> None:
        for name in ("download_bytes", "compute_s", "upload_bytes"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise InputError(f"{self.client}: {name} = {value}, at least 0 are wanted")


def work_of_messages(entries: Iterable[LedgerEntry], compute_s: Mapping[str, float]) -> dict[str, ClientWork]:
    """Return the work of the clients of one round, by vehicle, with the bytes of its messages by wireless.

    A client of the ledger, "region/vehicle", is the vehicle; `compute_s` has its time to compute [s]. Raises
    `InputError` for a vehicle that is not in `compute_s`, and for entries of several rounds, stages, tasks or regions.
    """
    moved: dict[str, Counter[str]] = {}
    found = set()
    for entry in entries:
        if entry.link == "wireless":
            region, _, vehicle = entry.client.rpartition("/")
            found.add((entry.stage, entry.task, entry.round, region))
            moved.setdefault(vehicle, Counter())[entry.direction] += entry.bytes
    if len(found) > 1:
        raise InputError(f"messages of {len(found)} rounds, stages, tasks or regions: those of one round are wanted")
    if unknown := [vehicle for vehicle in moved if vehicle not in compute_s]:
        raise InputError(f"{unknown[0]}: has no time to compute")
    return {name: ClientWork(name, sizes["down"], compute_s[name], sizes["up"]) for name, sizes in moved.items()}
