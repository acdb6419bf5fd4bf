"""Atomic file writing, JSON files and SHA-256 checksums."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from typing_extensions import TypeAliasType  # typing has it from Python 3.12 on; pydantic needs it for recursive types

Json = TypeAliasType("Json", "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None")

PIECE_BYTES = 1 << 16


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside `path` to write to; it is renamed to `path` on success and removed on failure.

    Creates missing parent folders. An `OSError` without a file name, such as one raised by a write, is raised on with
    `path` as its file name.
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


def find_existing(path: Path) -> Path:
    """Return `path`, or the nearest of its parents that exists."""
    return next(each for each in (path, *path.absolute().parents) if each.exists())


def check_writable(folder: Path) -> None:
    """Raise `PermissionError` if no file can be created in `folder`, or in its nearest existing parent.

    Leaves no file behind.
    """
    try:
        tempfile.TemporaryFile(dir=find_existing(folder)).close()
    except OSError as error:
        # PermissionError whatever the cause: a FileNotFoundError would be reported as a wrong input of the user
        raise PermissionError(error.errno, error.strerror, str(folder)) from None


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write `data` to `path` atomically."""
    with atomic_path(path) as temporary:
        write_in_pieces(temporary, data)


def write_in_pieces(path: Path, data: bytes | memoryview) -> None:
    """Write `data` to `path` in pieces of PIECE_BYTES.

    For one large write the kernel looks for contiguous free memory, which takes six times as long.
    """
    with path.open("wb") as file:
        for start in range(0, len(data), PIECE_BYTES):
            file.write(memoryview(data)[start : start + PIECE_BYTES])


def write_json(path: Path, value: Json, *, sort: bool = True) -> None:
    """Write `value` as indented JSON to `path`, atomically, with keys sorted or (`sort=False`) in their own order.

    Raises ValueError for a number that is not finite.
    """
    write_bytes(path, (json.dumps(value, indent=1, sort_keys=sort, allow_nan=False) + "\n").encode())


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
