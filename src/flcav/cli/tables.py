"""Tables that users hand over: CSV or Parquet, with the columns that were asked for."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from flcav.config import InputError


def read_table(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return the CSV or Parquet table at `path`; raises `InputError` if it is none or lacks one of `columns`."""
    try:
        table = pq.read_table(path) if path.suffix == ".parquet" else pyarrow.csv.read_csv(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise InputError(f"{path}: not a table ({' '.join(str(error).split())})") from None
    for column in columns:
        if column not in table.column_names:
            raise InputError(f"{path}: column '{column}' is missing; found {', '.join(table.column_names)}")
    if not table.num_rows:
        raise InputError(f"{path}: has no rows")
    return table


def numbers(table: pa.Table, columns: Sequence[str], path: Path) -> np.ndarray:
    """Return (rows, columns) finite floats; raises `InputError` naming `path`, the column, the row and the value."""
    out = np.empty((table.num_rows, len(columns)))
    for i, column in enumerate(columns):
        for row, value in enumerate(table[column].to_pylist()):
            try:
                out[row, i] = np.nan if value is None else float(value)
            except ValueError:
                out[row, i] = np.nan
            if not np.isfinite(out[row, i]):
                raise InputError(
                    f"{path}: row {row + 1}: {column} = {'nan' if value is None else value} is not a finite number"
                )
    return out
