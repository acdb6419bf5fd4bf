"""Validation of user-facing configuration: YAML and JSON files to frozen records, with one-sentence error messages.

Documents from elsewhere may be made to exhaust whoever reads them, and name files that are not theirs: nesting and what
aliases stand for are bounded before anything is built of them, and names lead nowhere but into their own folder.
"""

import errno
import json
import re
import stat
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PureWindowsPath
from types import NoneType
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails
from typing_extensions import TypeAliasType  # typing has it from Python 3.12 on; pydantic needs it for recursive types

from flcav.interface.wording import describe_number, hint_share, suggest

Json = TypeAliasType("Json", "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None")
Place = tuple[int | str, ...]  # path to a nested field: names of fields, indices and keys, as pydantic's `loc`

DEEPEST = 100  # most levels of nesting in a document
COPIED = 100_000  # most nodes that the aliases of a YAML document stand for
SCIENTIFIC = re.compile(r"[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+$")  # 1e-5, which YAML 1.1 takes for text, YAML 1.2 not
SHOWN = 80  # most characters of a wrong value that an error message quotes
MOST_BYTES = 1 << 28  # of a file that is read as a whole


SAFE_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Loader(SAFE_LOADER):
    """A safe YAML loader that reads 1e-5 as a number."""


Loader.add_implicit_resolver("tag:yaml.org,2002:float", SCIENTIFIC, list("-+0123456789"))


class InputError(ValueError):
    """Invalid user input. The message is one sentence for the user; the command line prints it and exits with 2."""


class DamagedFile(InputError):
    """A file that a program wrote and that is not what it wrote any more, or never was."""


class Config(BaseModel):
    """Base class of user-facing configurations: frozen; rejects unknown fields and numbers of implausible magnitude.

    Numbers far beyond any measurement are rejected here because they would overflow in later arithmetic.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    document: ClassVar[str | None] = None  # key of DOCUMENTS: the kind of file that holds this configuration
    magnitudes: ClassVar[tuple[float, float]] = (0.0, 1e15)  # limits of |x| of every float x other than 0

    @model_validator(mode="before")
    @classmethod
    def _refuse_booleans(cls, values: Any) -> Any:
        """Refuse YAML's `yes` and `no` for numbers, which Python takes for 1 and 0."""
        for name, value in values.items() if isinstance(values, dict) else ():
            field = cls.model_fields.get(name)
            if field is not None and _holds_boolean(value) and _leaf_types(field.annotation) <= {int, float}:
                raise ValueError(f"'{name}' is true or false (yes, no, on, off), and a number is wanted")
        return values

    @field_validator("*", mode="after")
    @classmethod
    def _check_magnitude(cls, value: Any) -> Any:
        least, most = cls.magnitudes
        for number in _list_floats(value):
            if number and not least <= abs(number) <= most:
                raise ValueError(f"a number's size, sign apart, must be from {least:g} to {most:g}, or 0")
        return value


def _holds_boolean(value: object) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_holds_boolean, value))
    return isinstance(value, bool) or (isinstance(value, dict) and any(isinstance(v, bool) for v in value.values()))


def _leaf_types(annotation: Any) -> set[Any]:
    """Return the types that an annotation is made of; None and the keys of mappings are left out."""
    origin = get_origin(annotation)
    if origin in (Literal, Callable):
        return {annotation}
    keys = int(isinstance(origin, type) and issubclass(origin, Mapping))
    parts = [part for part in get_args(annotation)[keys:] if isinstance(part, type) or get_args(part)]
    leaves = (_leaf_types(part) for part in parts if part is not NoneType)
    return set().union(*leaves) if parts else {annotation}


def _list_floats(value: object) -> Iterator[float]:
    """Yield the floats in a value, those in tuples and mappings included."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple | Mapping):
        for each in value.values() if isinstance(value, Mapping) else value:
            yield from _list_floats(each)


DOCUMENTS = {  # kinds of files that users write, by what they are called: the command that reads one
    "a dataset recipe": "flcav record {} --out DIR",
    "a run recipe": "flcav run {} --out DIR",
    "an allocation problem": "flcav allocate {}",
    "the progress of a plan": "flcav replan PROBLEM {}",
}


def recognise_document(values: Mapping[str, object]) -> str | None:
    """Return the kind of a document, a key of DOCUMENTS, by its fields; None where they do not tell."""
    tasks = values.get("tasks")
    if "regions" in values:
        return "a run recipe"
    if "town" in values:
        return "a dataset recipe"
    if isinstance(tasks, list) or "networks" in values or "nodes" in values:
        return "an allocation problem"
    if isinstance(tasks, dict) and any(isinstance(each, dict) and "samples" in each for each in tasks.values()):
        return "the progress of a plan"
    return None


ConfigT = TypeVar("ConfigT", bound=Config)


def parse_config(model: type[ConfigT], values: object, origin: str) -> ConfigT:
    """Return `values` as a validated instance of `model`.

    Raises `InputError` that names `origin`, the field, its value and the violated rule.
    """
    if values is None:
        raise InputError(f"{origin}: is empty")
    if not isinstance(values, dict):
        found = "text" if isinstance(values, str) else type(values).__name__
        raise InputError(f"{origin}: expected a mapping of fields, found {found}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        kind = recognise_document(values)
        if model.document is not None and kind is not None and kind != model.document:
            use = f"`{DOCUMENTS[kind].format(origin)}` reads it"
            raise InputError(f"{origin}: is {kind}, and {model.document} is wanted; {use}") from None
        raise InputError(f"{origin}: {describe_error(error, model)}") from None


def read_config(model: type[ConfigT], path: Path) -> ConfigT:
    """Return the YAML file at `path` as a validated instance of `model`.

    Raises `InputError` where the file is missing, is not YAML, or violates a rule of `model`.
    """
    return parse_config(model, read_yaml(path), str(path))


def read_yaml(path: Path, loader: type[Loader] = Loader) -> object:
    """Return the value in the YAML (or JSON) file at `path`; raises `InputError` if it is missing or not YAML."""
    check_is_file(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        _check_yaml(text)
        return yaml.load(text, loader)
    except (IsADirectoryError, yaml.YAMLError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not a YAML file ({error})") from None


def check_is_file(path: Path, most_bytes: int | None = MOST_BYTES) -> None:
    """Raise `InputError` where there is no regular file at `path`, or one of more than `most_bytes` (None: any size).

    A pipe or a device would be waited for, or read without end; a sparse file is as large as it says, once it is read.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENAMETOOLONG):  # a link to itself leads nowhere
            raise InputError(f"{path}: no such file") from None
        raise
    except ValueError:  # NUL in its name
        raise InputError(f"{shorten(str(path))}: no such file") from None
    if stat.S_ISDIR(found.st_mode):
        raise InputError(f"{path}: is a folder, and a file is wanted")
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{path}: is a pipe or a device, and a file is wanted")
    if most_bytes is not None and found.st_size > most_bytes:
        raise InputError(f"{path}: has {found.st_size} bytes; files of at most {most_bytes} are read")


def read_file(path: Path) -> bytes:
    """Return the bytes of the file at `path`; raises `InputError` as `check_is_file` does."""
    check_is_file(path)
    return path.read_bytes()


def _check_yaml(text: str) -> None:
    """Raise ValueError where a YAML document is nested beyond DEEPEST, or its aliases stand for more than COPIED nodes.

    Parsing into events takes neither recursion nor memory; the nodes of an alias are those of its anchor, copied.
    """
    size: dict[str, int] = {}  # by anchor: nodes within, aliases as what they stand for
    within: list[tuple[str | None, int]] = []  # anchors of the open collections, and the nodes before each
    nodes = copied = 0
    for event in yaml.parse(text, Loader):
        if isinstance(event, yaml.AliasEvent):
            copied += size.get(event.anchor, 0)
            nodes += size.get(event.anchor, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            within.append((event.anchor, nodes))
            nodes += 1
            size |= {event.anchor: COPIED + 1} if event.anchor else {}  # within itself: without end
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = within.pop()
            size |= {anchor: nodes - before} if anchor else {}
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            size |= {event.anchor: 1} if event.anchor else {}
        if len(within) > DEEPEST:
            raise ValueError(f"nested more than {DEEPEST} levels deep")
        if copied > COPIED:
            raise ValueError(f"its aliases stand for more than {COPIED} values")


def read_json(path: Path) -> Json:
    """Return the value in the JSON file at `path`; raises `InputError` if it is missing or not JSON."""
    check_is_file(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8-sig"))
        _check_depth(value)
    except (IsADirectoryError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None
    return value


def _check_depth(value: Json) -> None:
    """Raise ValueError where lists and mappings are nested beyond DEEPEST."""
    level = [value]
    for _ in range(DEEPEST):
        level = [each for one in level for each in _children(one) if isinstance(each, dict | list)]
        if not level:
            return
    raise ValueError(f"nested more than {DEEPEST} levels deep")


def _children(value: Json) -> Iterable[Json]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


class _Shallow(ElementTree.TreeBuilder):
    """A builder of the elements of an XML document; raises ValueError where they are nested beyond DEEPEST."""

    depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ValueError(f"nested more than {DEEPEST} levels deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)


def read_xml(path: Path, kind: str) -> ElementTree.Element:
    """Return the root of the XML file at `path`; comments may stand before its declaration.

    Raises `InputError` if it is missing or not XML, so no `kind`.
    """
    parser = ElementTree.XMLParser(target=_Shallow())
    text = read_file(path)
    try:
        parser.feed(text[max(text.find(b"<?xml "), 0) :])
        return parser.close()
    except (ElementTree.ParseError, IsADirectoryError, LookupError, ValueError) as error:
        raise InputError(f"{path}: not {kind} ({error})") from None


def path_within(folder: Path, name: str, origin: Path | str) -> Path:
    """Return the path of the file that is called `name` in the document `origin`, relative to `folder`.

    Raises `InputError` for a name that is empty or leads out of the folder by any system's rules: one that is absolute,
    begins with a drive letter, or has `..` or NUL in it. Links within the folder are left to whoever reads the file.
    """
    parts = PureWindowsPath(name)  # knows both slashes, and drives
    if not parts.parts or parts.anchor or ".." in parts.parts or "\0" in name:
        raise InputError(f"{origin}: {shorten(name)} is no name of a file in {folder}")
    return folder / name


def shorten(value: object) -> str:
    """Return the `repr` of a value for an error message; more than SHOWN characters are cut in the middle."""
    try:
        text = repr(value)
    except RecursionError:
        return f"a deeply nested {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2]} ... {text[-SHOWN // 4 :]}"


def describe_error(error: ValidationError, model: type[BaseModel]) -> str:
    """Return a validation error of `model` as a clause for an error message.

    It tells the first of the most deeply nested faults and counts the others: an outer field is reported as wrong
    whenever an inner one is, and a mapping as a text or a list where a field may be either and the fault is in it.
    """
    errors = error.errors()
    deepest = [each for each in errors if not any(_is_deeper(other, each) for other in errors)]
    first = next((each for each in deepest if _misspelt(each, model)), deepest[0])
    field = ".".join(str(part) for part in first["loc"] if "[" not in str(part)) or "(whole)"  # tags of unions
    more = f" (and {len(deepest) - 1} more)" if len(deepest) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _known_fields(model, first)
        return f"unknown field '{field}'; known fields: {', '.join(known)}{_misspelt(first, model)}{more}"
    if first["input"] is None:
        return f"field '{field}' is empty{more}"
    if first["type"] == "missing":
        return f"field '{field}' is missing{more}"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("model_type", "dict_type", "mapping_type"):
        models = _models_at(model, first["loc"])
        known = sorted({name for owner in models for name in owner.model_fields} if models != [model] else ())
        message = f"must be a mapping{' of the fields ' + ', '.join(known) if known else ''}"
    if first["type"] in ("float_parsing", "int_parsing"):
        message = describe_number(str(first["input"]), field)
    elif first["type"] in ("less_than", "less_than_equal") and 1 in first.get("ctx", {}).values():
        message += hint_share(float(first["input"]))
    if not first["loc"]:
        return f"{message}{more}"
    return f"field '{field}' = {shorten(first['input'])}: {message}{more}"


def _known_fields(model: type[BaseModel], error: ErrorDetails) -> list[str]:
    """Return the fields that `model` has where an unknown one was found."""
    return sorted({name for owner in _models_at(model, error["loc"][:-1]) for name in owner.model_fields})


def _misspelt(error: ErrorDetails, model: type[BaseModel]) -> str:
    """Return " (did you mean 'budgets_mb'?)" of an unknown field that is close to a known one, else ""."""
    if error["type"] != "extra_forbidden":
        return ""
    return suggest(str(error["loc"][-1]), _known_fields(model, error))


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
