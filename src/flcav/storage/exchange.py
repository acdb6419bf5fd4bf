"""Tables of users: CSV read, and tables written as CSV or Parquet by the suffix of the file's name."""

from collections.abc import Sequence
from pathlib import Path

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


def read_csv(path: Path | str, texts: Sequence[str] = ()) -> pa.Table:
    """Return the table in the CSV file at `path`, the columns `texts` as text.

    Raises `InputError` where it is missing or no table.
    """
    written = pyarrow.csv.ConvertOptions(column_types=dict.fromkeys(texts, pa.string()))
    check_is_file(Path(path))
    try:
        return pyarrow.csv.read_csv(path, convert_options=written)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        said = str(error) if str(error).isprintable() else "its bytes are no text"
        raise InputError(f"{path}: not a table ({said})") from None


def write_table(table: pa.Table, path: Path) -> None:
    """Write `table` atomically to `path`, as CSV or Parquet by its suffix; raises `InputError` for any other suffix."""
    check_ending(path)
    if path.suffix == ".parquet":
        write_parquet(table, path)
        return
    with atomic_path(path) as temporary:
        pyarrow.csv.write_csv(table, temporary)
