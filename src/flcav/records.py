"""Records and JSON: the one place that turns a frozen dataclass into what JSON holds, and back."""

from functools import cache
from typing import Annotated, Any, Self, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from flcav.config import InputError
from flcav.files import Json

Class = Annotated[str, Field(alias="class")]  # a field that JSON calls "class", a word that Python keeps for itself
LEFT_OUT = Field(exclude_if=lambda value: value is None)  # of a field, in `Annotated`: None is not in JSON

RecordT = TypeVar("RecordT")


class Record:
    """A frozen dataclass of JSON values, and of records, mappings and tuples of them."""

    def as_json(self) -> dict[str, Json]:
        """Return the record as JSON has it, its fields in their order."""
        return to_json(self, type(self))

    @classmethod
    def of_json(cls, values: Json, origin: str) -> Self:
        """Return what `as_json` returned as a record again; raises `InputError` naming `origin` where it is no such."""
        return of_json(cls, values, origin)


def to_json(record: RecordT, kind: type[RecordT]) -> dict[str, Json]:
    """Return a dataclass as JSON has it, its fields in their order; `kind` is its class, with what it is generic in."""
    return _adapter(kind).dump_python(record, mode="json", by_alias=True)


def of_json(kind: type[RecordT], values: Json, origin: str) -> RecordT:
    """Return what `to_json` returned as a record again; raises `InputError` naming `origin` where it is no such."""
    try:
        return _adapter(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{origin}: not a result of this version of flcav (field '{where}': {first['msg']}); run it anew, in "
            "another folder"
        ) from None


@cache
def _adapter(record: type) -> TypeAdapter[Any]:
    return TypeAdapter(record)
