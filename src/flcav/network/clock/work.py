"""The work of clients in a round: bytes down, seconds of training, bytes up; also by the messages of a ledger."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from flcav.config import InputError
from flcav.network.ledger import LedgerEntry


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
