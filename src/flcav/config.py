"""User-facing configuration: YAML in, a frozen and checked record out, one sentence where it is wrong."""

import json
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from flcav.files import Json

SHOWN = 80  # characters of a wrong value in the sentence about it


class InputError(ValueError):
    """What the user gave cannot be used. The message is one sentence for them; the command line exits with 2."""


class Config(BaseModel):
    """Base of every user-facing configuration: frozen, no unknown field passes, and no number that nobody can mean.

    Numbers far beyond what can be measured overflow in arithmetic, long after they were read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    magnitudes: ClassVar[tuple[float, float]] = (0.0, 1e15)  # least and most of a number other than 0, sign apart

    @field_validator("*", mode="after")
    @classmethod
    def _of_a_magnitude(cls, value: Any) -> Any:
        least, most = cls.magnitudes
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and number and not least <= abs(number) <= most:
                raise ValueError(f"a number's size, sign apart, must be from {least:g} to {most:g}, or 0")
        return value


ConfigT = TypeVar("ConfigT", bound=Config)
Place = tuple[int | str, ...]  # of a field within fields


def parse_config(model: type[ConfigT], values: object, origin: str) -> ConfigT:
    """Return `values` as a checked `model`; raises `InputError` naming `origin`, the field, the value, the rule."""
    if not isinstance(values, dict):
        raise InputError(f"{origin}: expected a mapping of fields, found {type(values).__name__}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{origin}: {tell(error, model)}") from None


def read_config(model: type[ConfigT], path: Path) -> ConfigT:
    """Return the YAML file at `path` as a checked `model`; raises `InputError`."""
    return parse_config(model, read_yaml(path), str(path))


def read_yaml(path: Path) -> object:
    """Return what the YAML (or JSON) file at `path` holds; raises `InputError`."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (IsADirectoryError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a YAML file ({error})") from None


def read_json(path: Path) -> Json:
    """Return what the JSON file at `path` holds; raises `InputError`."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (IsADirectoryError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None


def shorten(value: object) -> str:
    """Return a value as a sentence shows it."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2]} ... {text[-SHOWN // 4 :]}"


def tell(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the first of the deepest faults that were found in fields of `model`, in words."""
    errors = error.errors()
    deepest = [each for each in errors if not any(_inside(other["loc"], each["loc"]) for other in errors)]
    first = deepest[0]
    field = ".".join(str(part) for part in first["loc"]) or "(whole)"
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


def _inside(place: Place, outer: Place) -> bool:
    """Return whether `place` lies within `outer`: a fault there makes the whole faulty too."""
    return len(place) > len(outer) and place[: len(outer)] == outer


def _models_at(model: type[BaseModel], place: Place) -> list[type[BaseModel]]:
    """Return the models that may stand at `place`; numbers, keys and tags of unions lead from none to another."""
    found = [model]
    for part in place:
        within = [owner.model_fields[part].annotation for owner in found if part in owner.model_fields]
        found = [each for annotation in within for each in _models_in(annotation)] or found
    return found


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]
