"""Validation of user-facing configuration: YAML and JSON files to frozen records, with one-sentence error messages."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator
from pydantic_core import ErrorDetails

from flcav.files import Json

Place = tuple[int | str, ...]  # path to a nested field: names of fields, indices and keys, as pydantic's `loc`

SHOWN = 80  # most characters of a wrong value that an error message quotes


class InputError(ValueError):
    """Invalid user input. The message is one sentence for the user; the command line prints it and exits with 2."""


class DamagedFile(InputError):
    """A file that a program wrote and that is not what it wrote any more, or never was."""


class Config(BaseModel):
    """Base class of user-facing configurations: frozen; rejects unknown fields and numbers of implausible magnitude.

    Numbers far beyond any measurement are rejected here because they would overflow in later arithmetic.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    magnitudes: ClassVar[tuple[float, float]] = (0.0, 1e15)  # limits of |x| of every float x other than 0

    @field_validator("*", mode="after")
    @classmethod
    def _check_magnitude(cls, value: Any) -> Any:
        least, most = cls.magnitudes
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and number and not least <= abs(number) <= most:
                raise ValueError(f"a number's size, sign apart, must be from {least:g} to {most:g}, or 0")
        return value


ConfigT = TypeVar("ConfigT", bound=Config)


def parse_config(model: type[ConfigT], values: object, origin: str) -> ConfigT:
    """Return `values` as a validated instance of `model`.

    Raises `InputError` that names `origin`, the field, its value and the violated rule.
    """
    if not isinstance(values, dict):
        raise InputError(f"{origin}: expected a mapping of fields, found {type(values).__name__}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{origin}: {describe_error(error, model)}") from None


def read_config(model: type[ConfigT], path: Path) -> ConfigT:
    """Return the YAML file at `path` as a validated instance of `model`.

    Raises `InputError` where the file is missing, is not YAML, or violates a rule of `model`.
    """
    return parse_config(model, read_yaml(path), str(path))


def read_yaml(path: Path) -> object:
    """Return the value in the YAML (or JSON) file at `path`; raises `InputError` if it is missing or not YAML."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (IsADirectoryError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a YAML file ({error})") from None


def read_json(path: Path) -> Json:
    """Return the value in the JSON file at `path`; raises `InputError` if it is missing or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (IsADirectoryError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None


def shorten(value: object) -> str:
    """Return the `repr` of a value for an error message; more than SHOWN characters are cut in the middle."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2]} ... {text[-SHOWN // 4 :]}"


def describe_error(error: ValidationError, model: type[BaseModel]) -> str:
    """Return a validation error of `model` as a clause for an error message.

    It tells the first of the most deeply nested faults and counts the others: an outer field is reported as wrong
    whenever an inner one is, and a mapping as a text or a list where a field may be either and the fault is in it.
    """
    errors = error.errors()
    deepest = [each for each in errors if not any(_is_deeper(other, each) for other in errors)]
    first = deepest[0]
    field = ".".join(str(part) for part in first["loc"] if "[" not in str(part)) or "(whole)"  # tags of unions
    more = f" (and {len(deepest) - 1} more)" if len(deepest) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = sorted({name for owner in _models_at(model, first["loc"][:-1]) for name in owner.model_fields})
        return f"unknown field '{field}'; known fields: {', '.join(known)}{more}"
    if first["input"] is None:
        return f"field '{field}' is empty{more}"
    if first["type"] == "missing":
        return f"field '{field}' is missing{more}"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("model_type", "dict_type", "mapping_type"):
        models = _models_at(model, first["loc"])
        known = sorted({name for owner in models for name in owner.model_fields} if models != [model] else ())
        message = f"must be a mapping{' of the fields ' + ', '.join(known) if known else ''}"
    return f"field '{field}' = {shorten(first['input'])}: {message}{more}"


def _is_deeper(one: ErrorDetails, other: ErrorDetails) -> bool:
    """Return whether `one` is nested within `other`, or within a mapping that `other` wants to be a text or a list."""
    place, outer = one["loc"], other["loc"]
    if other["type"] in ("string_type", "tuple_type") and isinstance(other["input"], Mapping):
        return len(place) > len(outer) and _inside(place, outer[:-1])
    return _inside(place, outer)


def _inside(place: Place, outer: Place) -> bool:
    """Return whether the field at `place` is nested within the field at `outer`."""
    return len(place) > len(outer) and place[: len(outer)] == outer


def _models_at(model: type[BaseModel], place: Place) -> list[type[BaseModel]]:
    """Return the models that the type annotations allow at `place`; none where they want something else.

    Indices, keys and tags of unions in the path do not change the model.
    """
    found = [model]
    for part in place:
        if within := [owner.model_fields[part].annotation for owner in found if part in owner.model_fields]:
            found = [each for annotation in within for each in _models_in(annotation)]
    return found


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]
