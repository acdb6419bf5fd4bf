"""User-facing configuration: YAML in, a frozen and checked record out, one sentence where it is wrong."""

from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError


class InputError(ValueError):
    """What the user gave cannot be used. The message is one sentence for them; the command line exits with 2."""


class Config(BaseModel):
    """Base of every user-facing configuration: frozen, and no unknown field passes."""

    model_config = ConfigDict(frozen=True, extra="forbid")


ConfigT = TypeVar("ConfigT", bound=Config)
Place = tuple[int | str, ...]  # of a field within fields


def parse_config(model: type[ConfigT], values: object, origin: str) -> ConfigT:
    """Return `values` as a checked `model`; raises `InputError` naming `origin`, the field, the value, the rule."""
    if not isinstance(values, dict):
        raise InputError(f"{origin}: expected a mapping of fields, found {type(values).__name__}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{origin}: {_sentence(error, model)}") from None


def read_config(model: type[ConfigT], path: Path) -> ConfigT:
    """Return the YAML file at `path` as a checked `model`; raises `InputError`."""
    return parse_config(model, read_yaml(path), str(path))


def read_yaml(path: Path) -> object:
    """Return what the YAML (or JSON) file at `path` holds; raises `InputError`."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (IsADirectoryError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a YAML file ({reason})") from None


def _sentence(error: ValidationError, model: type[BaseModel]) -> str:
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
    return f"field '{field}' = {first['input']!r}: {message}{more}"


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
