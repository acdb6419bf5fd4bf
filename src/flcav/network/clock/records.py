"""Records of the clock of rounds: work and times of the clients, and the reasons of missing updates."""

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
    """The times of one client in one round [s], on the trace's clock."""

    client: str  # e.g. "cav0"
    server: str  # edge server at the start of the round, e.g. "pole3"
    round: int
    start_s: float  # its edge server starts to send the model
    download_s: float  # duration, up to a drop
    compute_s: float  # duration
    upload_s: float  # duration
    end_s: float  # arrival of its update, or drop
    downloaded_bytes: int
    uploaded_bytes: int
    dropped: str  # reason why its update did not arrive, e.g. "left the town"; empty where it did


@dataclass(frozen=True)
class RoundTiming:
    """One round on the trace's clock [s]: wireline download, then the clients, then wireline upload."""

    round: int  # from 1
    start_s: float
    end_s: float
    wireline_down_s: float  # duration from cloud to edge servers; 0 where the round does not start a cloud round
    wireline_up_s: float  # duration from edge servers to cloud; 0 where the round does not end a cloud round
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
        of_round = list(group)
        about = {field.name: of_round[0][f"round_{field.name}"] for field in _ROUND}
        clients = (ClientTiming(**{field.name: row[field.name] for field in fields(ClientTiming)}) for row in of_round)
        records.append(RoundTiming(round=number, clients=tuple(clients), **about))
    return tuple(records)


@dataclass(frozen=True)
class ClientWork:
    """The work of a client in a round. Raises `InputError` for a number that is negative or not finite."""

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
    """Return the work of the clients of one round, by vehicle, with the bytes of their wireless messages.

    The vehicle is the last part of a client's name in the ledger, "region/vehicle"; `compute_s` has its computing time
    [s]. Raises `InputError` for a vehicle that is not in `compute_s`, and for entries of several rounds, stages, tasks
    or regions.
    """
    moved: dict[str, Counter[str]] = {}
    rounds = set()
    for entry in entries:
        if entry.link == "wireless":
            region, _, vehicle = entry.client.rpartition("/")
            rounds.add((entry.stage, entry.task, entry.round, region))
            moved.setdefault(vehicle, Counter())[entry.direction] += entry.bytes
    if len(rounds) > 1:
        raise InputError(f"messages of {len(rounds)} rounds, stages, tasks or regions: those of one round are wanted")
    if unknown := [vehicle for vehicle in moved if vehicle not in compute_s]:
        raise InputError(f"{unknown[0]}: has no time to compute")
    return {name: ClientWork(name, sizes["down"], compute_s[name], sizes["up"]) for name, sizes in moved.items()}
