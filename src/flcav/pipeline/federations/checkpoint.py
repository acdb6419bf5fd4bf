"""The checkpoint of a federation after a round: its record, and the SHA-256 of each file that belongs to it.

The last two are kept, so that one damaged file costs one round.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from flcav.config import InputError, Json, read_json
from flcav.federation.state import RoundRecord
from flcav.interface.progress import DAMAGED
from flcav.storage.files import sha256, write_bytes, write_json
from flcav.storage.records import Record

LAST, BEFORE = "round.json", "round-before.json"  # the last checkpoint, and the one before
OWN = "own_sha256"  # of all other fields of the record


@dataclass(frozen=True)
class Checkpoint(Record):
    """The checkpoint of a federation after a round."""

    round: int
    entries: int  # of the ledger then
    losses: tuple[float | None, ...]  # of each round
    by: str  # what the federation is by: strategy and rules
    sha256: Mapping[str, str]  # of each file, by name: weights of all rounds, ledger, and state where there is any
    records: Mapping[str, tuple[RoundRecord, ...]] = field(default_factory=dict)  # of the rounds, by federation
    scores: tuple[Mapping[str, float], ...] = ()  # on validation frames after each round, by region

    def find_damage(self, folder: Path) -> str | None:
        """Return the name of a file that is missing or not what was written; None where all are whole."""
        for name, known in self.sha256.items():
            if not (folder / name).exists() or sha256(folder / name) != known:
                return name
        return None

    def keep(self, folder: Path) -> None:
        """Write the checkpoint; the last one becomes the one before."""
        if (folder / LAST).exists():
            write_bytes(folder / BEFORE, (folder / LAST).read_bytes())
        values = self.as_json()
        write_json(folder / LAST, values | {OWN: hash_json(values)}, sort=False)

    @classmethod
    def read(cls, folder: Path, name: str) -> "Checkpoint":
        """Return the checkpoint that `keep` wrote; raises `InputError` where it is another now."""
        values = read_json(folder / name)
        known = values.pop(OWN, None) if isinstance(values, dict) else None
        if known != hash_json(values):
            raise InputError(f"{folder / name} {DAMAGED}")
        return cls.from_json(values, str(folder / name))


def hash_json(values: Json) -> str:
    """Return the SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def find_checkpoint(folder: Path) -> tuple[Checkpoint | None, str]:
    """Return the last checkpoint of which nothing is damaged, and a sentence about those that are; "" where none is.

    None means the beginning: there is no checkpoint, or the first is damaged. Raises `InputError` where the last two
    are.
    """
    told = []
    for name in (LAST, BEFORE):
        if not (folder / name).exists():
            continue
        try:
            found = Checkpoint.read(folder, name)
            damaged = found.find_damage(folder)
        except InputError:
            damaged = name
        else:
            if damaged is None:
                return found, "; ".join(told)
        told.append(f"{folder / damaged} {DAMAGED}, the checkpoint before it is used")
    if len(told) == 2:
        raise InputError(f"{folder}: the last two checkpoints are damaged; remove the folder to begin anew")
    return None, "; ".join(told)
