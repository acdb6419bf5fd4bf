"""Conversion of frozen dataclasses to JSON values and back, by pydantic, and to rows of a table.

Tables of users: CSV read, and tables written as CSV or Parquet by the suffix of the file's name.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Self, TypeVar

import pyarrow as pa
import pyarrow.csv as csv
from pydantic import Field, TypeAdapter, ValidationError

from flcav.config import InputError, Json, check_is_file
from flcav.storage.files import atomic_path, write_parquet

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Class = Annotated[str, Field(alias="class")]  # a field named "class" in JSON, a reserved word in Python
LEFT_OUT = Field(exclude_if=lambda value: value is None)  # for `Annotated`: not in the JSON where it is None
WHERE_TRUE = Field(exclude_if=lambda value: not value)  # for `Annotated`: in the JSON where it is true

LOOKED_AT = 65_536  # bytes of a CSV file, by which its separator is told

RecordT = TypeVar("RecordT")


class Record:
    """Base class of frozen dataclasses whose fields are JSON values, records, or mappings and tuples of these."""

    def as_json(self) -> dict[str, Json]:
        """Return the record as a JSON object, with its fields in the order of their definition."""
        return to_json(self, type(self))

    @classmethod
    def from_json(cls, values: Json, origin: str) -> Self:
        """Return the record that `as_json` made `values` of; raises `InputError` naming `origin` if they do not fit."""
        return from_json(cls, values, origin)


def to_json(record: RecordT, kind: type[RecordT]) -> dict[str, Json]:
    """Return a dataclass as a JSON object, with its fields in order; `kind` is its class with its type arguments."""
    return _adapter(kind).dump_python(record, mode="json", by_alias=True)


def from_json(kind: type[RecordT], values: Json, origin: str) -> RecordT:
    """Return the `kind` that `to_json` made `values` of; raises `InputError` naming `origin` if they do not fit."""
    try:
        return _adapter(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{origin}: not a result of this version of flcav (field '{where}': {first['msg']}); run it anew, in "
            "another folder"
        ) from None


def to_rows(records: Iterable["DataclassInstance"]) -> list[dict[str, Json]]:
    """Return a row of a table for each record; `pandas.DataFrame` and `polars.DataFrame` take the list.

    Fields of a record within a record are columns of their own, named as in "estimate.mean".

    >>> from flcav.statistics.estimates import Estimate
    >>> to_rows([Estimate(0.5, 0.4, 0.6)])
    [{'mean': 0.5, 'low': 0.4, 'high': 0.6}]
    """
    return [dict(flatten_record(to_json(record, type(record)))) for record in records]


def flatten_record(values: Mapping[str, Json], above: str = "") -> Iterator[tuple[str, Json]]:
    """Yield the values within nested JSON objects by dotted names, as in "estimate.mean"; empty objects are values."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from flatten_record(value, f"{above}{name}.")
        else:
            yield above + name, value


@cache
def _adapter(record: type) -> TypeAdapter[Any]:
    return TypeAdapter(record)


ENDINGS = (".csv", ".parquet")


def check_ending(path: Path) -> None:
    """Raise `InputError` where the suffix of `path` is none of ENDINGS."""
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: tables are written as {' or '.join(ENDINGS)}; end the name with one of them")


def read_csv(path: Path | str | BinaryIO, texts: Sequence[str] = (), origin: str = "") -> pa.Table:
    """Return the table in the CSV file at `path`, or in an open one called `origin`, the columns `texts` as text.

    Only an empty cell is None; "NaN" is a number, "NA" is text. Cells may be separated by semicolons or tabs, where the
    header has these and no commas; numbers among semicolons may have decimal commas. Raises `InputError` where the file
    is missing or no table, or a column is there twice.
    """
    named = origin or str(path)
    if isinstance(path, Path | str):
        check_is_file(Path(path))
    try:
        separator, point = _find_separator(path)
        written = csv.ConvertOptions(
            column_types=dict.fromkeys(texts, pa.string()), null_values=[""], decimal_point=point
        )
        table = csv.read_csv(path, parse_options=csv.ParseOptions(delimiter=separator), convert_options=written)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        said = str(error) if str(error).isprintable() else "its bytes are no text"
        raise InputError(f"{named}: not a table ({said})") from None
    for name in table.column_names:
        if name and table.column_names.count(name) > 1:
            raise InputError(f"{named}: column '{name}' is there twice; found {', '.join(table.column_names)}")
    return table


def _find_separator(path: Path | str | BinaryIO) -> tuple[str, str]:
    """Return what separates the cells of a CSV file by its header, and the decimal point of its numbers."""
    if isinstance(path, Path | str):
        with Path(path).open("rb") as file:
            return _find_separator(file)
    begins = path.tell()
    header, rest = path.readline(LOOKED_AT), path.read(LOOKED_AT)
    path.seek(begins)
    if "\0" in header.decode(errors="ignore") or header.decode(errors="ignore").encode() != header:
        return ",", "."  # compressed, in UTF-16, or no text
    separator = next((mark for mark in (b";", b"\t") if mark in header and b"," not in header), b",")
    comma = separator == b";" and re.search(rb"(^|;)\s*-?\d+,\d+\s*(;|\r|\n|$)", rest)
    return separator.decode(), "," if comma else "."


def write_any_table(table: pa.Table, path: Path) -> None:
    """Write `table` atomically to `path`, as CSV or Parquet by its suffix; raises `InputError` for any other suffix."""
    check_ending(path)
    if path.suffix == ".parquet":
        write_parquet(table, path)
        return
    with atomic_path(path) as temporary:
        csv.write_csv(table, temporary)
