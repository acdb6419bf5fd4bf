"""Reader of users' tables (CSV or Parquet), with checks of columns and numbers."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from flcav.config import InputError, shorten
from flcav.storage.files import read_parquet
from flcav.storage.records import read_csv

CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def read_input_table(path: Path, columns: Sequence[str], names: Sequence[str] = ()) -> pa.Table:
    """Return the CSV or Parquet table at `path`; raises `InputError` if it is no table, empty, or lacks a column.

    Columns in `names` of a CSV keep their spelling, such as "007", unless all their values are plain whole numbers.
    """
    table = read_parquet(path) if path.suffix.lower() == ".parquet" else _read_csv(path, names)
    for column in dict.fromkeys((*columns, *table.column_names)):
        if table.column_names.count(column) != 1:
            found = "is missing" if column not in table.column_names else "is there twice"
            raise InputError(f"{path}: column '{column}' {found}; found {', '.join(table.column_names)}")
    for column in table.column_names:
        if pa.types.is_string(table[column].type) and any(map(CONTROL.search, table[column].drop_null().to_pylist())):
            raise InputError(f"{path}: column '{column}' has characters that cannot be printed")
    if not table.num_rows:
        raise InputError(f"{path}: has no rows")
    return table


def _read_csv(path: Path, names: Sequence[str]) -> pa.Table:
    if path.suffix.lower() in (".yaml", ".yml", ".json"):
        raise InputError(f"{path}: a table is wanted, .csv or .parquet, and no {path.suffix[1:].upper()} file")
    table = read_csv(path, names)
    table = table.rename_columns([column.strip() for column in table.column_names])
    for name in {*names}.intersection(table.column_names):
        text = table[name]
        try:
            whole = text.cast(pa.int64())
        except pa.ArrowInvalid:
            continue
        if whole.cast(pa.string()).equals(text):
            table = table.set_column(table.column_names.index(name), name, whole)
    return table


def numbers(table: pa.Table, columns: Sequence[str], path: Path) -> np.ndarray:
    """Return columns as an array of finite floats (rows, columns); raises `InputError` with row, column and value."""
    out = np.empty((table.num_rows, len(columns)))
    for i, column in enumerate(columns):
        for row, value in enumerate(table[column].to_pylist()):
            try:
                out[row, i] = np.nan if value is None else float(value)
            except (TypeError, ValueError, OverflowError):
                out[row, i] = np.nan
            if not np.isfinite(out[row, i]):
                if value is None or (isinstance(value, str) and not value.strip()):
                    raise InputError(f"{path}: row {row + 1}: {column} is empty, and must be a finite number")
                raise InputError(f"{path}: row {row + 1}: {column} = {shorten(value)} is not a finite number")
    return out
