"""Conversion of frozen dataclasses to JSON values and back, by pydantic, and to rows of a table.

Tables of users: reading of CSV, and writing as CSV or Parquet by the suffix of the file's name.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
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
LEFT_OUT = Field(exclude_if=lambda value: value is None)  # for `Annotated`: left out of the JSON where it is None
WHERE_TRUE = Field(exclude_if=lambda value: not value)  # for `Annotated`: only in the JSON where it is true

RecordT = TypeVar("RecordT")


class Record:
    """Base class of frozen dataclasses whose fields are JSON values, records, or mappings and tuples of these."""

    def as_json(self) -> dict[str, Json]:
        """Return the record as a JSON object, with its fields in the order of their definition."""
        return to_json(self, type(self))

    @classmethod
    def from_json(cls, values: Json, origin: str) -> Self:
        """Return the record with `values` as its `as_json`; raises `InputError` naming `origin` if they do not fit."""
        return from_json(cls, values, origin)


def to_json(record: RecordT, kind: type[RecordT]) -> dict[str, Json]:
    """Return a dataclass as a JSON object, with its fields in order; `kind` is its class with its type arguments."""
    return _adapter(kind).dump_python(record, mode="json", by_alias=True)


def from_json(kind: type[RecordT], values: Json, origin: str) -> RecordT:
    """Return the `kind` with `values` as its `to_json`; raises `InputError` naming `origin` if they do not fit."""
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

    Fields of a record within a record are separate columns, named as in "estimate.mean".

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


def select(rows: Iterable[RecordT], **values: str | int | Collection[str] | None) -> list[RecordT]:
    """Return the rows, or other records, whose fields have these values; of a collection of values any of them."""
    wanted = {name: (value,) if isinstance(value, str | int | None) else value for name, value in values.items()}
    return [row for row in rows if all(getattr(row, name) in among for name, among in wanted.items())]


@cache
def _adapter(record: type) -> TypeAdapter[Any]:
    return TypeAdapter(record)


ENDINGS = (".csv", ".parquet")  # of the files that tables are written to


def check_ending(path: Path) -> None:
    """Raise `InputError` where the suffix of `path` is none of ENDINGS."""
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: tables are written as {' or '.join(ENDINGS)}; end the name with one of them")


def read_csv(path: Path | str | BinaryIO, texts: Sequence[str] = (), origin: str = "") -> pa.Table:
    """Return the table in the CSV file at `path`, or in an open one called `origin`, the columns `texts` as text.

    Only an empty cell is None; "NaN" is a number, "NA" is text. The file may be as spreadsheets write it: with
    semicolons or tabs between the cells, decimal commas, in a Windows code page or UTF-16. Raises `InputError` where
    the file is missing or not a table, or where two columns have the same name.
    """
    named = origin or str(path)
    written = csv.ConvertOptions(column_types=dict.fromkeys(texts, pa.string()), null_values=[""])
    if isinstance(path, Path | str):
        check_is_file(Path(path))
    try:
        data = Path(path).read_bytes() if isinstance(path, Path | str) else path.read()
        data, delimiter = _as_utf8(data)
        table = csv.read_csv(
            pa.BufferReader(data), parse_options=csv.ParseOptions(delimiter=delimiter), convert_options=written
        )
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error) if str(error).isprintable() else "its bytes are no text"
        raise InputError(f"{named}: not a table ({reason})") from None
    for name in table.column_names:
        if name and table.column_names.count(name) > 1:
            raise InputError(f"{named}: column '{name}' is there twice; found {', '.join(table.column_names)}")
    for place, name in enumerate(table.column_names):
        if pa.types.is_string(table[name].type) and name not in texts:
            table = table.set_column(place, name, _read_decimal_commas(table[name], delimiter))
    return table


MARK = b"\xef\xbb\xbf"  # of UTF-8, at the beginning of a spreadsheet's CSV
WIDE = (b"\xff\xfe", b"\xfe\xff")  # marks of UTF-16, in which spreadsheets save "Unicode text"
DECIMAL = re.compile(r"\s*[+-]?(\d+|\d{1,3}(\.\d{3})+)(,\d+)?\s*")
THOUSANDS = re.compile(r"\s*[+-]?\d{1,3}(,\d{3})+\s*")


def _as_utf8(data: bytes) -> tuple[bytes, str]:
    """Return the text of a CSV file as UTF-8, without the mark of its encoding, and what separates its cells."""
    if data.startswith(WIDE):
        data = data.decode("utf-16").encode()
    data = data.removeprefix(MARK)
    try:
        data.decode()
    except UnicodeDecodeError:
        if b"\0" not in data:
            data = data.decode("cp1252").encode()
    head, _, rest = data.partition(b"\n")
    if head.rstrip().lower().startswith(b"sep=") and len(head.rstrip()) == 5:  # as Excel says it
        return rest, chr(head[4])
    bare = re.sub(rb'"[^"]*"', b"", head)
    return data, max(",;\t", key=lambda sign: bare.count(sign.encode()))


def _read_decimal_commas(column: pa.ChunkedArray, delimiter: str) -> pa.ChunkedArray:
    """Return a column of text as numbers where all of it is numbers with decimal commas.

    Where commas are between the cells "1,234" is text, since it is a thousand there.
    """
    said = column.to_pylist()
    known = [text for text in said if text is not None and text.strip()]
    if not any("," in text for text in known) or not all(map(DECIMAL.fullmatch, known)):
        return column
    if delimiter == "," and all(THOUSANDS.fullmatch(text) for text in known if "," in text):
        return column
    numbers = [None if not (text or "").strip() else float(text.replace(".", "").replace(",", ".")) for text in said]
    return pa.chunked_array([pa.array(numbers, pa.float64())])


def write_any_table(table: pa.Table, path: Path) -> None:
    """Write `table` atomically to `path`, as CSV or Parquet by its suffix; raises `InputError` for any other suffix."""
    check_ending(path)
    if path.suffix == ".parquet":
        write_parquet(table, path)
        return
    with atomic_path(path) as temporary:
        csv.write_csv(table, temporary)
