"""Tables of users: CSV read, and tables written as CSV or Parquet by the suffix of the file's name."""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa
import pyarrow.csv

from flcav.config import InputError, check_is_file
from flcav.storage.files import atomic_path
from flcav.storage.parquet import write_parquet

ENDINGS = (".csv", ".parquet")


def check_ending(path: Path) -> None:
    """Raise `InputError` where the suffix of `path` is none of ENDINGS."""
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: tables are written as {' or '.join(ENDINGS)}; end the name with one of them")


def read_csv(path: Path | str | BinaryIO, texts: Sequence[str] = (), origin: str = "") -> pa.Table:
    """Return the table in the CSV file at `path`, or in an open one called `origin`, the columns `texts` as text.

    Only an empty cell is None; "NaN" is a number, "NA" is text. Raises `InputError` where the file is missing or no
    table, or a column is there twice.
    """
    named = origin or str(path)
    written = pyarrow.csv.ConvertOptions(column_types=dict.fromkeys(texts, pa.string()), null_values=[""])
    if isinstance(path, Path | str):
        check_is_file(Path(path))
    try:
        table = pyarrow.csv.read_csv(path, convert_options=written)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        said = str(error) if str(error).isprintable() else "its bytes are no text"
        raise InputError(f"{named}: not a table ({said})") from None
    for name in table.column_names:
        if name and table.column_names.count(name) > 1:
            raise InputError(f"{named}: column '{name}' is there twice; found {', '.join(table.column_names)}")
    return table


def write_table(table: pa.Table, path: Path) -> None:
    """Write `table` atomically to `path`, as CSV or Parquet by its suffix; raises `InputError` for any other suffix."""
    check_ending(path)
    if path.suffix == ".parquet":
        write_parquet(table, path)
        return
    with atomic_path(path) as temporary:
        pyarrow.csv.write_csv(table, temporary)
