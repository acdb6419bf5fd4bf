"""Tables that are handed to users and their tools: CSV or Parquet, by the ending of the file's name."""

from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from flcav.config import InputError
from flcav.files import atomic_path

ENDINGS = (".csv", ".parquet")


def check_ending(path: Path) -> None:
    """Raise `InputError` where the ending of `path` names no format of tables."""
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: tables are written as {' or '.join(ENDINGS)}; end the name with one of them")


def write_table(table: pa.Table, path: Path) -> None:
    """Write `table` atomically as the ending of `path` says; raises `InputError` for another ending."""
    check_ending(path)
    with atomic_path(path) as temporary:
        if path.suffix == ".csv":
            pyarrow.csv.write_csv(table, temporary)
        else:
            pq.write_table(table, temporary)
