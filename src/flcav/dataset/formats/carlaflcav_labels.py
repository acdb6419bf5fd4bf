"""Labels of CarlaFLCAV's recorder: a pickled list of records, read without unpickling.

A pickle is a program: unpickling runs it, and it may call anything that can be imported. Here no such program is run.
`pickletools.genops` only splits the bytes into operations, and `_evaluate` carries out the few that a list of plain
records needs. It is safe for these reasons:

- *Nothing is imported or called.* A class is not a Python object but a name, one of RECORDS; any other name is refused.
  Creating a record gives an inert `PickledRecord`, and its state becomes a dictionary, never attributes.
- *Every other operation is refused*: those that call (REDUCE, INST, OBJ, NEWOBJ_EX), the extension registry, persistent
  ids, buffers, and whatever a later protocol may add.
- *Memory and time are bounded.* A file has at most MOST_BYTES, each operation adds at most one small value and copies
  nothing, and lengths and indices in the file allocate nothing: the memo is a dictionary.
- *Nothing recurses.* Values are read along a fixed path, label -> transform -> location -> x, and the kind of record is
  checked at each step, so that depth and cycles have no effect.
"""

import pickletools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, check_is_file, shorten
from flcav.dataset.formats.reading import FARTHEST
from flcav.geometry import Array, pose

MOST_BYTES = 2**22  # largest file; a label takes about 300
MOST_LABELS = 10_000
RECORDS: Mapping[tuple[str, str], str] = {  # module and name of the recorder's classes -> kind of record
    ("utils.label_types", "ObjectLabel"): "label",
    ("utils.geometry_types", "Transform"): "transform",
    ("utils.geometry_types", "BoundingBox"): "box",
    ("utils.geometry_types", "Location"): "vector",
    ("utils.geometry_types", "Vector3d"): "vector",
    ("utils.geometry_types", "Rotation"): "rotation",
}
CATEGORIES = {"vehicle": "car", "pedestrian": "pedestrian"}


class ActorLabels(NamedTuple):
    """The M labels at an instant, in the recorder's right-handed world frame."""

    track: NDArray[np.str_]  # (M,) CARLA's actor ids
    category: NDArray[np.str_]  # (M,)
    world_from_actor: Array  # (M, 4, 4) [m]
    world_from_box: Array  # (M, 4, 4) [m] of the boxes' centres
    size: Array  # (M, 3) length, width, height [m]; may be 0 or below


@dataclass(frozen=True)
class Class:
    """A class named in a pickle, reduced to the kind of its records."""

    kind: str


@dataclass
class PickledRecord:
    """A record in a pickle: inert, its state is data."""

    kind: str
    state: dict[str, "Value"] = field(default_factory=dict)


Value = int | float | str | Class | PickledRecord | tuple[()] | list["Value"] | dict[str, "Value"] | None


def read_labels(path: Path) -> ActorLabels:
    """Return the labels in a file of the recorder; raises `InputError` where it is missing or holds anything else."""
    check_is_file(path)
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    try:
        if len(data) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES} bytes")
        labels = _evaluate(data)
        if not isinstance(labels, list) or len(labels) > MOST_LABELS:
            raise ValueError(f"it is no list of at most {MOST_LABELS} labels")
        rows = [_decode_label(_check_record(label, "label")) for label in labels]
        if len({track for track, *_ in rows}) != len(rows):
            raise ValueError("two labels of one actor")
    except (ValueError, IndexError, KeyError) as error:
        said = str(error) if type(error) is ValueError and str(error).isprintable() else "it is malformed"
        raise InputError(f"{path}: not labels of CarlaFLCAV ({said})") from None
    track, category, actor, box, size = zip(*rows) if rows else ((),) * 5
    count = len(rows)
    return ActorLabels(
        np.array(track, np.str_).reshape(count),
        np.array(category, np.str_).reshape(count),
        np.array(actor, np.float64).reshape(count, 4, 4),
        np.array(box, np.float64).reshape(count, 4, 4),
        np.array(size, np.float64).reshape(count, 3),
    )


def _decode_label(label: PickledRecord) -> tuple[str, str, Array, Array, Array]:
    """Return track, category, `world_from_actor`, `world_from_box` and size of a label."""
    number = label.state["carla_id"]
    kind = label.state["label_type"]
    if not isinstance(number, int) or not isinstance(kind, str) or kind not in CATEGORIES:
        raise ValueError("a label without the number of an actor, or that is neither vehicle nor pedestrian")
    actor, box = (_find_record(label, *path) for path in (("transform", "transform"), ("bounding_box", "box")))
    world_from_actor = _read_pose(actor)
    size = 2 * np.array(_read_numbers(_find_record(box, "extent", "vector"), "xyz"))
    return str(number), CATEGORIES[kind], world_from_actor, world_from_actor @ _read_pose(box), size


def _read_pose(record: PickledRecord) -> Array:
    """Return the pose (4, 4) [m] of a record with a location [m] and a rotation [degrees]."""
    place = _read_numbers(_find_record(record, "location", "vector"), "xyz")
    turn = _read_numbers(_find_record(record, "rotation", "rotation"), ("yaw", "pitch", "roll"))
    return pose(*place, *np.radians(turn))


def _find_record(record: PickledRecord, name: str, kind: str) -> PickledRecord:
    return _check_record(record.state[name], kind)


def _check_record(value: Value, kind: str) -> PickledRecord:
    if not isinstance(value, PickledRecord) or value.kind != kind:
        raise ValueError(f"it has something else in the place of a {kind}")
    return value


def _read_numbers(record: PickledRecord, names: Iterable[str]) -> list[float]:
    values = [record.state[name] for name in names]
    numbers = [float(value) for value in values if isinstance(value, int | float) and abs(value) < FARTHEST]
    if len(numbers) != len(values):
        raise ValueError(f"a {record.kind} of other than finite numbers")
    return numbers


def _evaluate(data: bytes) -> Value:
    """Return the value of a pickle of plain records; raises ValueError, IndexError or KeyError for any other pickle."""
    stack: list[Value] = []
    marks: list[int] = []  # lengths of the stack
    memo: dict[int, Value] = {}
    argument: Any  # None only for operations without one
    for code, argument, _ in pickletools.genops(data):
        match code.name:
            case "PROTO" | "FRAME":
                pass
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "SHORT_BINUNICODE" | "BINUNICODE":
                stack.append(argument)
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_TUPLE":
                stack.append(())
            case "MARK":
                marks.append(len(stack))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(_find_class(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                name, module = stack.pop(), stack.pop()
                stack.append(_find_class(module, name))
            case "NEWOBJ":
                arguments, record_class = stack.pop(), stack.pop()
                if not isinstance(record_class, Class) or arguments != ():
                    raise ValueError("a record made of more than its class")
                stack.append(PickledRecord(record_class.kind))
            case "BUILD":
                state, record = stack.pop(), stack[-1]
                if not isinstance(record, PickledRecord) or not isinstance(state, dict):
                    raise ValueError("a state of other than a record")
                record.state = state
            case "SETITEM" | "SETITEMS":
                items = _pop_items(stack, len(stack) - 2 if code.name == "SETITEM" else marks.pop())
                held = stack[-1]
                names = [name for name in items[::2] if isinstance(name, str)]
                if not isinstance(held, dict) or len(names) != len(items[1::2]):
                    raise ValueError("items of other than a mapping of names")
                held.update(zip(names, items[1::2]))
            case "APPEND" | "APPENDS":
                items = _pop_items(stack, len(stack) - 1 if code.name == "APPEND" else marks.pop())
                held = stack[-1]
                if not isinstance(held, list):
                    raise ValueError("items of other than a list")
                held.extend(items)
            case "STOP":
                return stack.pop()
            case other:
                raise ValueError(f"the operation {other}")
    raise ValueError("it has no end")


def _pop_items(stack: list[Value], first: int) -> list[Value]:
    if first < 1:
        raise ValueError("items of nothing")
    items = stack[first:]
    del stack[first:]
    return items


def _find_class(module: Value, name: Value) -> Class:
    if not isinstance(module, str) or not isinstance(name, str):
        raise ValueError("a class without a name")
    if (module, name) not in RECORDS:
        raise ValueError(f"it names {shorten(f'{module}.{name}')}")
    return Class(RECORDS[module, name])
