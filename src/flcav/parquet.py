"""Strict reading of Parquet files, and their writing as a whole."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import InputError
from flcav.files import write_bytes


def read_parquet(path: Path) -> pa.Table:
    """Return the table in a Parquet file, validated in full: its strings are UTF-8.

    Raises `InputError` where the file is missing, not Parquet, or damaged.
    """
    try:
        table = pq.ParquetFile(path).read()
        table.validate(full=True)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (pa.ArrowException, OSError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({error})") from None
    return table


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table to a Parquet file atomically; raises `OSError` that names the file where the disk is full."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, memoryview(sink.getvalue()))
