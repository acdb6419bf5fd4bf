"""Results that are appended one by one to a file of JSON lines, so that interrupted work can be resumed."""

import hashlib
import json
from pathlib import Path

from flcav.config import Json, read_file


def hash_request(request: Json) -> str:
    """Return the key of a result: a hash of everything that determines it."""
    return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:24]


def read_kept(path: Path | None, field: str) -> dict[str, Json]:
    """Return the results in a file, from the `field` of each line, by key; a truncated last line is left out."""
    known = {}
    for line in read_file(path).decode().splitlines() if path is not None and path.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        known[row["key"]] = row[field]
    return known


def keep(path: Path | None, key: str, field: str, result: Json) -> None:
    """Append a result to a file, if there is one; it starts with a line break, as the last line may be truncated."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps({"key": key, field: result}))
