"""Files changed at random, as mistakes and damage change them: bytes, and what the bytes say.

A mutation is drawn from a generator, so that its seed names it, and returns what it did in words.
"""

import csv
import io
import json
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
import yaml
from PIL import Image

Rng = np.random.Generator
Node = tuple[Any, Any]  # a list or mapping, and the index or key of one of its values

NUMBERS: tuple[float, ...] = (
    *(0, 1, -1, 2, 7, 1000, 2**31, -(2**31), 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, 10**400),
    *(-0.0, 0.5, 1e-9, 1e-300, 1e-320, 5e-324, -5e-324, 1e9, 1e20, 1e155, 1e300, 1.7e308, -1.7e308),
    *(float("inf"), float("-inf"), float("nan")),
)
TEXTS = (
    *("", " ", "x", "2020-13-45", "é", "\N{GRINNING FACE}", "a\nb", "\x00", "nan", "1e309", "-1e309", "1e-320", "0x10"),
    *("true", "null", "..", "../../x", "/", "veh0", "cav0", "cav9", "x" * 5000, "[red]x[/red]", "%s", "{0}"),
)  # fmt: skip
NAMES = (  # of files and folders, which lead elsewhere or stand for something else
    *("/etc/hostname", "C:\\x", "\\\\host\\x", "../secret", "a/../../../secret", "x/..", ".", "joined", "town"),
    *("traces", "manifest.json", "recipe.json", "frames.parquet", ".recording", "-x", "CON", "x/y", "a" * 300),
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"x": 1}, [1, 2], [2, 1], ["a", "a"])
ODD = (*NUMBERS, *TEXTS, *OTHERS)
NOT_UTF8 = b"\xff\xfe\x80"


def mutate(path: Path, rng: Rng) -> str:
    """Change the file at `path` in place; the file itself is replaced, so that links to it keep what they hold."""
    data = path.read_bytes()
    told = MUTATIONS.get(path.suffix)
    if told is None or rng.random() < 0.3:
        return f"{path.name}: {_mutate_bytes(path, data, rng)}"
    path.unlink()
    try:
        return f"{path.name}: {told(path, data, rng)}"
    except (ValueError, TypeError, OverflowError, RecursionError, pa.ArrowException):  # the format knows no such value
        path.write_bytes(b"")
        return f"{path.name}: {_mutate_bytes(path, data, rng)}"


def odd_number(rng: Rng) -> str:
    """Return an extreme number, as text."""
    return _text(_drawn(NUMBERS, rng))


def _drawn(values: Any, rng: Rng) -> Any:
    return values[int(rng.integers(len(values)))]


def _text(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)


def _said(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:30]}... ({len(text)} characters)"


def _mutate_bytes(path: Path, data: bytes, rng: Rng) -> str:
    """Change the bytes of a file, or the file as a whole."""
    path.unlink()
    first, last = np.sort(rng.integers(0, len(data) + 1, 2)).tolist()
    last = min(last, first + int(rng.integers(1, 64)))
    done, changed = _drawn(
        [
            (f"truncated to {first} bytes", data[:first]),
            (f"without bytes {first} to {last}", data[:first] + data[last:]),
            (f"bytes {first} to {last} twice", data[:last] + data[first:]),
            (f"bytes {first} to {last} zero", data[:first] + bytes(last - first) + data[last:]),
            (f"no UTF-8 at byte {first}", data[:first] + NOT_UTF8 + data[first:]),
            (f"no UTF-8 instead of byte {first}", data[:first] + NOT_UTF8[:1] + data[first + 1 :]),
            ("empty", b""),
            ("noise", rng.bytes(len(data) or 1)),
            *[_with_flips(data, rng) for _ in range(6)],
            ("gone", None),
            ("a folder", None),
        ],
        rng,
    )
    if changed is not None:
        path.write_bytes(changed)
    elif done == "a folder":
        path.mkdir()
    return done


def _with_flips(data: bytes, rng: Rng) -> tuple[str, bytes]:
    """Return up to eight flipped bits; files say most at their ends."""
    changed = bytearray(data)
    places = []
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        near = min(len(data), _drawn((32, 512, len(data)), rng))
        place = int(rng.integers(near))
        places.append(place if rng.random() < 0.5 else len(data) - 1 - place)
        changed[places[-1]] ^= 1 << int(rng.integers(8))
    return f"bits flipped in bytes {places}", bytes(changed)


def mutate_values(values: Any, rng: Rng) -> str:
    """Change one value of nested lists and mappings."""
    nodes = list(_nodes(values))
    if not nodes:
        return "nothing"
    owner, key = _drawn(nodes, rng)
    where = f"{_said(key)} = {_said(owner[key])}"
    draw = rng.random()
    if draw < 0.1:
        del owner[key]
        return f"without {where}"
    if draw < 0.2:
        _, (other, place) = key, _drawn(nodes, rng)
        owner[key] = json.loads(json.dumps(other[place], default=str))
        return f"{where} is now {_said(owner[key])}"
    if draw < 0.3 and isinstance(owner, dict):
        name = _drawn(TEXTS, rng)
        owner[name] = _drawn(ODD, rng)
        return f"{_said(name)} = {_said(owner[name])} beside {where}"
    if draw < 0.3:
        owner.insert(key, owner[key])
        return f"{where} twice"
    if draw < 0.35:
        owner[key] = _nested(int(_drawn((3, 50, 3000), rng)))
        return f"{where} is now nested"
    old = owner[key]
    if draw > 0.9 and isinstance(old, str):
        texts = [other[place] for other, place in nodes if isinstance(other[place], str)]
        owner[key] = _drawn(NAMES if draw > 0.93 else texts, rng)
        return f"{where} is now called {_said(owner[key])}"
    number = isinstance(old, int | float) and not isinstance(old, bool)
    owner[key] = _drawn(NUMBERS if number and rng.random() < 0.7 else ODD, rng)
    return f"{where} is now {_said(owner[key])}"


def _nodes(values: Any) -> Iterator[Node]:
    if isinstance(values, dict | list):
        for key in list(values) if isinstance(values, dict) else range(len(values)):
            yield values, key
            yield from _nodes(values[key])


def _nested(depth: int) -> list[Any]:
    values: list[Any] = []
    for _ in range(depth):
        values = [values]
    return values


def _mutate_yaml(path: Path, data: bytes, rng: Rng) -> str:
    values = yaml.safe_load(data)
    done = mutate_values(values, rng)
    try:
        path.write_text(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), encoding="utf-8")
    except RecursionError:
        path.write_text("a: " + "[" * 3000 + "]" * 3000)
    return done


def _mutate_json(path: Path, data: bytes, rng: Rng) -> str:
    values = json.loads(data)
    done = mutate_values(values, rng)
    path.write_bytes(_as_json(values))
    return done


def _as_json(values: Any) -> bytes:
    try:
        return json.dumps(values).encode()
    except RecursionError:
        return b"[" * 100_000 + b"]" * 100_000


def _mutate_csv(path: Path, data: bytes, rng: Rng) -> str:
    rows = list(csv.reader(io.StringIO(data.decode())))
    done = mutate_values(rows, rng) if rng.random() < 0.2 else _mutate_cell(rows, rng)
    text = io.StringIO()
    csv.writer(text).writerows([row if isinstance(row, list) else [row] for row in rows])
    path.write_bytes(text.getvalue().encode())
    return done


def _mutate_cell(rows: list[list[str]], rng: Rng) -> str:
    number = int(rng.integers(0 if rng.random() < 0.2 else 1, len(rows)))
    column = int(rng.integers(len(rows[number])))
    rows[number][column] = _text(_drawn(NUMBERS if rng.random() < 0.7 else (*TEXTS, *NAMES), rng))
    return f"row {number}, column {column} is now {_said(rows[number][column])}"


def _mutate_parquet(path: Path, data: bytes, rng: Rng) -> str:
    table = pq.read_table(pa.BufferReader(data))
    metadata = table.schema.metadata or {}
    if metadata and rng.random() < 0.4:
        name = _drawn([name for name in metadata if not name.startswith(b"ARROW")] or list(metadata), rng)
        values = json.loads(metadata[name])
        done = mutate_values(values, rng)
        pq.write_table(table.replace_schema_metadata({**metadata, name: _as_json(values)}), path)
        return done
    table, done = _mutate_table(table, rng)
    pq.write_table(table, path)
    return done


def _mutate_feather(path: Path, data: bytes, rng: Rng) -> str:
    table, done = _mutate_table(feather.read_table(pa.BufferReader(data)).combine_chunks(), rng)
    feather.write_feather(table, path)
    return done


def _mutate_table(table: pa.Table, rng: Rng) -> tuple[pa.Table, str]:
    draw, column = rng.random(), int(rng.integers(table.num_columns))
    field = table.schema.field(column)
    if draw < 0.06:
        return table.remove_column(column), f"without the column {field.name}"
    if draw < 0.1:
        return table.rename_columns([*table.column_names[:column], "x", *table.column_names[column + 1 :]]), "renamed"
    if draw < 0.16 or not len(table):
        kind = _drawn([pa.string(), pa.float32(), pa.int8(), pa.binary(), pa.bool_(), pa.null()], rng)
        return table.set_column(column, field.name, pa.nulls(len(table), kind)), f"{field.name} is now {kind}"
    if draw < 0.24:
        rows = [
            rng.integers(len(table), size=len(table)),
            rng.permutation(len(table)),
            np.arange(len(table) - 1),
            [*range(len(table)), len(table) - 1],
        ]
        return table.take(_drawn(rows, rng)), "other rows"
    row = int(rng.integers(len(table)))
    cells = table[column].to_pylist()
    cells[row] = _odd_cell(cells[row], field.type, rng)
    said = f"{field.name} of row {row} is now {_said(cells[row])}"
    return table.set_column(column, field, _array(cells, field.type)), said


def _odd_cell(cell: Any, kind: pa.DataType, rng: Rng) -> Any:
    if rng.random() < 0.05:
        return None
    if pa.types.is_list(kind):
        cells = list(cell or [])
        draw = rng.random()
        if draw < 0.3:
            return [*cells, _odd_cell(None, kind.value_type, rng)]
        if draw < 0.5 or not cells:
            return cells[:-1]
        cells[int(rng.integers(len(cells)))] = _odd_cell(cells[0], kind.value_type, rng)
        return cells
    if pa.types.is_string(kind):
        return _drawn((*TEXTS, *NAMES, NOT_UTF8, cell), rng)
    if pa.types.is_integer(kind):
        bits = kind.bit_width
        return _drawn((0, 1, -1, 7, 10**4, 2**31 - 1, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1), rng)
    return float(_drawn([number for number in NUMBERS if abs(number) < 10**308 or number != number], rng))


def _array(cells: list[Any], kind: pa.DataType) -> pa.Array:
    """Return the cells as Arrow has them, text that is no UTF-8 included."""
    if pa.types.is_string(kind):
        raw = [cell.encode() if isinstance(cell, str) else cell for cell in cells]
        return pa.array(raw, pa.binary()).view(pa.string())
    if pa.types.is_list(kind) and pa.types.is_string(kind.value_type):
        raw = [None if cell is None else [t.encode() if isinstance(t, str) else t for t in cell] for cell in cells]
        lists = pa.array(raw, pa.list_(pa.binary()))
        return pa.ListArray.from_arrays(lists.offsets, lists.values.view(pa.string()))
    if pa.types.is_fixed_size_list(kind):
        kind = pa.list_(kind.value_type)
    return pa.array(cells, kind)


def _mutate_safetensors(path: Path, data: bytes, rng: Rng) -> str:
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    draw = rng.random()
    if draw < 0.4:
        numbers = np.frombuffer(body, _drawn(("<f4", "<f2"), rng), len(body) // 4)
        number = _drawn((np.nan, np.inf, 1e-40, 3e38, -3e38, 0.0), rng)
        with np.errstate(over="ignore"):
            numbers[rng.integers(len(numbers), size=int(_drawn((1, 100, len(numbers)), rng)))] = number
        done = f"numbers are now {number}"
    elif draw < 0.7:
        metadata = header["__metadata__"]
        name = _drawn(list(metadata), rng)
        values = json.loads(metadata[name])
        done = f"{name}: {mutate_values(values, rng)}"
        metadata[name] = _as_json(values).decode()
    else:
        done = mutate_values(header, rng)
    text = _as_json(header)
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)
    return done


def _mutate_numbers(path: Path, data: bytes, rng: Rng) -> str:
    """Change float32 numbers of a cloud."""
    numbers = np.frombuffer(data, "<f4", len(data) // 4).copy()
    number = _drawn((np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 1e20, -1.0, 0.0), rng)
    count = int(_drawn((1, 4, len(numbers)), rng))
    numbers[rng.integers(len(numbers), size=count)] = number
    path.write_bytes(numbers.tobytes())
    return f"{count} numbers are now {number}"


def _mutate_picture(path: Path, data: bytes, rng: Rng) -> str:
    """Put another picture there: of another size, mode or kind."""
    size = _drawn(((1, 1), (31, 64), (64, 32), (96, 64), (97, 64), (9000, 32)), rng)
    mode = _drawn(("RGB", "L", "1", "P", "RGBA", "CMYK", "I;16", "F", "LA"), rng)
    kind = _drawn((path.suffix[1:].replace("jpg", "jpeg"), "png", "jpeg", "webp", "tiff", "gif"), rng)
    picture = Image.new("RGB", size, (200, 30, 30)) if mode in ("LA",) else Image.new(mode, size)
    try:
        picture.save(path, kind)
    except (OSError, KeyError):
        Image.new("L", size).save(path, kind)
    return f"a picture {size}, {mode}, {kind}"


def _mutate_xml(path: Path, data: bytes, rng: Rng) -> str:
    root = ElementTree.fromstring(data)
    parents = [element for element in root.iter() if len(element)]
    holders = [element for element in root.iter() if element.attrib]
    draw = rng.random()
    if draw < 0.2:
        parent = _drawn(parents, rng)
        child = _drawn(list(parent), rng)
        parent.remove(child)
        done = f"without a <{child.tag}>"
    elif draw < 0.3:
        parent = _drawn(parents, rng)
        child = _drawn(list(parent), rng)
        parent.append(child)
        done = f"a <{child.tag}> twice"
    else:
        element = _drawn(holders, rng)
        name = _drawn(list(element.attrib), rng)
        if draw < 0.4:
            del element.attrib[name]
            done = f"<{element.tag}> without {name}"
        else:
            value = _text(_drawn([odd for odd in (*NUMBERS, *TEXTS) if odd != "\x00"], rng))
            element.attrib[name] = value
            done = f"{name} of a <{element.tag}> is now {_said(value)}"
    path.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
    return done


def _mutate_words(path: Path, data: bytes, rng: Rng) -> str:
    """Change one word of a text file."""
    lines = [line.split(" ") for line in data.decode().splitlines()]
    done = _mutate_cell(lines, rng) if lines else "nothing"
    path.write_text("\n".join(" ".join(words) for words in lines) + "\n")
    return done


MUTATIONS: dict[str, Callable[[Path, bytes, Rng], str]] = {
    ".yaml": _mutate_yaml,
    ".json": _mutate_json,
    ".csv": _mutate_csv,
    ".parquet": _mutate_parquet,
    ".feather": _mutate_feather,
    ".safetensors": _mutate_safetensors,
    ".bin": _mutate_numbers,
    ".png": _mutate_picture,
    ".jpg": _mutate_picture,
    ".webp": _mutate_picture,
    ".xodr": _mutate_xml,
    ".xml": _mutate_xml,
    ".txt": _mutate_words,
}


def link_tree(source: Path, target: Path) -> None:
    """Make `target` a copy of a folder whose files are links to those of `source`."""
    shutil.copytree(source, target, copy_function=lambda one, other: Path(other).hardlink_to(one))
