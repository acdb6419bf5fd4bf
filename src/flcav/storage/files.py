"""Atomic and durable file writing, JSON files and SHA-256 checksums.

Strict reading of Parquet files, and their writing as a whole.
"""

import contextlib
import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import InputError, Json, check_is_file

PIECE_BYTES = 1 << 16  # of a single write
SYNCING = 8  # files that are flushed in parallel: the file system commits them together, ten times as fast


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary file in the folder of `path` to write to; renamed to `path` on success, removed on failure.

    It is flushed to the disk before it is renamed, and its folder after that, so that a crash of the machine leaves
    either the old file or the whole new one. Creates missing parent folders. An `OSError` without a file name, such as
    one raised by a write, is raised on with `path` as its file name.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(path)
        _flush(path.parent)
    except OSError as error:
        if error.strerror and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Flush a file, or the names in a folder, from the system's cache to the disk: fsync(2)."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def flush_all(paths: Iterable[Path]) -> None:
    """Flush files, and the names in folders, to the disk, except symbolic links."""
    with ThreadPoolExecutor(SYNCING) as threads:
        for _ in threads.map(_flush, (path for path in paths if not path.is_symlink())):
            pass  # raises the OSError of a file


def flush_tree(folder: Path) -> None:
    """Flush a folder, everything below it and its name in its parent to the disk."""
    flush_all([folder.parent, folder, *folder.rglob("*")])


def find_existing(path: Path) -> Path:
    """Return `path`, or the nearest of its parents that exists."""
    return next(candidate for candidate in (path, *path.absolute().parents) if candidate.exists())


def check_writable(folder: Path) -> None:
    """Raise `PermissionError` if no file can be created in `folder`, or in its nearest existing parent.

    Leaves no file behind.
    """
    try:
        tempfile.TemporaryFile(dir=find_existing(folder)).close()
    except OSError as error:
        # PermissionError whatever the cause: a FileNotFoundError would be reported as an invalid input of the user
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
    """Write `value` as indented JSON to `path`, atomically, with keys sorted or, with `sort=False`, in the order given.

    Raises ValueError for a number that is not finite.
    """
    write_bytes(path, (json.dumps(value, indent=1, sort_keys=sort, allow_nan=False) + "\n").encode())


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


HARMLESS_BYTES = 1 << 28  # size in memory of a table that is read without further checks
UNFOLDED = 1000  # greatest ratio of the sizes in memory and in the file of a larger table; usual ones are below 10


def read_parquet(path: Path) -> pa.Table:
    """Return the table in a Parquet file, fully validated, so that its strings are UTF-8.

    Raises `InputError` where the file is missing, not Parquet, or damaged, and, before it is read, where it would take
    far more memory than tables do (a decompression bomb).
    """
    check_is_file(path, None)
    try:
        file = pq.ParquetFile(path)
        if (size := _measure_table(file.metadata)) > max(HARMLESS_BYTES, UNFOLDED * path.stat().st_size):
            raise ValueError(f"it would take {size} bytes of memory")
        table = file.read()
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({error})") from None
    return table


def _measure_table(metadata: Any) -> int:
    """Return the size [bytes] of a file's values in memory by its metadata: at least eight a value, or their pages."""
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    columns = (group.column(j) for group in groups for j in range(group.num_columns))
    return sum(max(8 * column.num_values, column.total_uncompressed_size) for column in columns)


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table to a Parquet file atomically; raises `OSError` that names the file where the disk is full."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, memoryview(sink.getvalue()))
