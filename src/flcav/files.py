"""Files written whole or not at all."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from typing_extensions import TypeAliasType  # of typing from Python 3.12 on: what pydantic checks by

Json = TypeAliasType("Json", "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None")

PIECE_BYTES = 1 << 16


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write; renamed to `path` on success, removed on any failure.

    An `OSError` that does not know its file, as those of writing, names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        if error.strerror and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(folder: Path) -> None:
    """Raise `OSError` where nothing can be written below `folder`; leaves nothing behind."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        # even where the system says that something is not there: it is not the user who named a wrong input
        raise PermissionError(error.errno, error.strerror, str(folder)) from None


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_path(path) as temporary:
        fill(temporary, data)


def fill(path: Path, data: bytes | memoryview) -> None:
    """Write `data` to `path`, in pieces: for large ones the kernel seeks runs of free memory, at six times the cost."""
    with path.open("wb") as file:
        for start in range(0, len(data), PIECE_BYTES):
            file.write(memoryview(data)[start : start + PIECE_BYTES])


def write_json(path: Path, value: Json, *, sort: bool = True) -> None:
    """Write `value` as indented JSON to `path`, atomically; with sorted keys, or in their own order."""
    write_bytes(path, (json.dumps(value, indent=1, sort_keys=sort, allow_nan=False) + "\n").encode())


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, as hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
