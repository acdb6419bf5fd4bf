"""Strict reading of Parquet files, and their writing as a whole."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import InputError, check_is_file
from flcav.storage.files import write_bytes

HARMLESS_BYTES = 1 << 28  # that any table may take in memory
UNFOLDED = 1000  # most bytes in memory that a byte of a larger table stands for; unlike rows unfold to a few


def read_parquet(path: Path) -> pa.Table:
    """Return the table in a Parquet file, validated in full: its strings are UTF-8.

    Raises `InputError` where the file is missing, not Parquet, or damaged, and before it is read where it would unfold
    to far more than tables do.
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
    """Return the bytes that a file's values take, by what its metadata says: at least eight each, or their pages'."""
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    columns = (group.column(j) for group in groups for j in range(group.num_columns))
    return sum(max(8 * column.num_values, column.total_uncompressed_size) for column in columns)


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table to a Parquet file atomically; raises `OSError` that names the file where the disk is full."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, memoryview(sink.getvalue()))
