"""Conversion of frozen dataclasses to JSON values and back, by pydantic, and to rows of a table."""

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from flcav.config import InputError, Json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Class = Annotated[str, Field(alias="class")]  # a field named "class" in JSON, a reserved word in Python
LEFT_OUT = Field(exclude_if=lambda value: value is None)  # for `Annotated`: not in the JSON where it is None
WHERE_TRUE = Field(exclude_if=lambda value: not value)  # for `Annotated`: in the JSON where it is true

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
    return [dict(flatten(to_json(record, type(record)))) for record in records]


def flatten(values: Mapping[str, Json], above: str = "") -> Iterator[tuple[str, Json]]:
    """Yield the values within nested JSON objects by dotted names, as in "estimate.mean"; empty objects are values."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{above}{name}.")
        else:
            yield above + name, value


@cache
def _adapter(record: type) -> TypeAdapter[Any]:
    return TypeAdapter(record)
