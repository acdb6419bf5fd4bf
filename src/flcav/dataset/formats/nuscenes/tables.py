"""nuScenes' tables as streams of rows, so that tables of gigabytes are never in memory as a whole."""

import math
import sys
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from json import JSONDecodeError, JSONDecoder
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from flcav.config import InputError, check_is_file, read_json, shorten
from flcav.dataset.formats.reading import FARTHEST, ROUNDED
from flcav.interface.wording import plural

Row = Mapping[str, Any]  # column -> value

CHUNK = 1 << 20  # characters read at a time
COLUMNS = {  # required columns of each table
    "scene": ("name", "log_token", "first_sample_token"),
    "log": ("logfile", "vehicle"),
    "sample": ("timestamp", "scene_token"),
    "sample_data": (
        "sample_token",
        "ego_pose_token",
        "calibrated_sensor_token",
        "is_key_frame",
        "filename",
        "timestamp",
    ),
    "ego_pose": ("translation", "rotation"),
    "calibrated_sensor": ("sensor_token", "translation", "rotation", "camera_intrinsic"),
    "sensor": ("channel", "modality"),
    "category": ("name",),
    "attribute": ("name",),
    "instance": ("category_token",),
    "sample_annotation": ("sample_token", "instance_token", "translation", "size", "rotation"),
}
LINKS = ("prev", "next")  # columns with the token of another row of the table, "" for none
OPTIONAL = {
    "sample": LINKS,
    "sample_data": ("width", "height", *LINKS),
    "sample_annotation": ("attribute_tokens", "visibility_token", *LINKS),
}
NUMBERS = {"translation": 3, "size": 3, "rotation": 4}  # columns of lists of numbers, with their length
MODALITIES = ("lidar", "camera", "radar")
BLANKS = " \t\n\r"


class References:
    """References from rows to missing rows: counted by table and column, with the first of each.

    Only hashes of LINKS are kept, eight bytes each, since tables have millions of rows.
    """

    def __init__(self) -> None:
        self._lost: dict[
            tuple[str, str], list[str]
        ] = {}  # (table, column) -> the first token, and an entry per further one

    def check_links(self, rows: Iterable[Row], name: str, path: Path) -> Iterator[Row]:
        """Yield the rows of a table without their LINKS; then count links that lead to no row, or back in time.

        Raises `InputError` where two rows have the same token.
        """
        token, time = array("q"), array("q")
        links = {link: array("q") for link in LINKS}
        for row in rows:
            token.append(hash(row["token"]))
            time.append(row.get("timestamp", 0))
            for link, hashes in links.items():
                hashes.append(hash(row[link]) if row.get(link) else 0)
            yield {column: value for column, value in row.items() if column not in LINKS}
        known, times = np.array(token), np.array(time)
        order = np.argsort(known, kind="stable")
        if len(twins := np.flatnonzero(np.diff(known[order]) == 0)):
            one, other = order[twins[0] : twins[0] + 2].tolist()
            raise InputError(f"{path}: the rows {one} and {other} have one token; each row has its own")
        for link, hashes in links.items():
            linked = np.flatnonzero(np.array(hashes))
            wanted = np.array(hashes)[linked]
            at = order[np.minimum(np.searchsorted(known[order], wanted), len(known) - 1)]
            there = known[at] == wanted
            self._lost.setdefault((name, link), []).extend(f"of row {row}" for row in linked[~there].tolist())
            back = (times[at] - times[linked]) * (1 if link == "next" else -1) < 0
            self._lost.setdefault((name, f"{link} timestamp"), []).extend(
                f"of row {row}" for row in linked[there & back].tolist()
            )

    def miss(self, name: str, column: str, token: str) -> None:
        """Count a reference from a row of a table to a missing row."""
        self._lost.setdefault((name, column), []).append(shorten(token))

    def notes(self) -> Iterator[str]:
        """Yield a sentence for every table and column with such references."""
        for (name, column), lost in self._lost.items():
            link, _, timed = column.partition(" ")
            what = "leads back in time" if timed else "is the token of no row"
            if lost:
                yield f"{name}.json: '{link}' of {plural(len(lost), 'row')} {what}, first {lost[0]}"


def keep_all(_row: Row) -> bool:
    """Return True."""
    return True


def read_rows_by_token(folder: Path, name: str, kept: Callable[[Row], bool] = keep_all) -> dict[str, Row]:
    """Return the rows of a table by token, those that are `kept`.

    Raises `InputError` as `stream_table` does, and where two rows have the same token.
    """
    rows: dict[str, Row] = {}
    for row in stream_table(folder, name, kept):
        if rows.setdefault(row["token"], row) is not row:
            raise InputError(f"{folder / name}.json: two rows have the token {shorten(row['token'])}")
    return rows


def stream_table(folder: Path, name: str, kept: Callable[[Row], bool] = keep_all) -> Iterator[Row]:
    """Yield the rows of the table `name` in `folder` that are `kept`, with token, COLUMNS and their OPTIONAL columns.

    Raises `InputError` where the file is missing or no table, or a row lacks one of COLUMNS.
    """
    path, wanted, also = folder / f"{name}.json", sorted({"token", *COLUMNS[name]}), OPTIONAL.get(name, ())
    for number, row in enumerate(_stream_list(path)):
        if not isinstance(row, dict) or not row.keys() >= set(wanted):
            lost = next(column for column in wanted if column not in row) if isinstance(row, dict) else "token"
            raise InputError(f"{path}: row {number} has no '{lost}'")
        columns = {column: row[column] for column in (*wanted, *also) if column in row}
        if odd := [column for column, value in columns.items() if not _fits(column, value)]:
            raise InputError(f"{path}: row {number} has a '{odd[0]}' that is none: {shorten(columns[odd[0]])}")
        if kept(columns):
            yield {column: _share(value) if column.endswith("token") else value for column, value in columns.items()}


def _share(token: object) -> object:
    """Return the interned string equal to a token, which is in many rows but then only once in memory."""
    return sys.intern(token) if isinstance(token, str) else token


def _stream_list(path: Path) -> Iterator[object]:
    """Yield the elements of the JSON list in a file one by one; raises `InputError` where it holds none."""
    check_is_file(path, None)  # without a limit of size, as it is read in pieces
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield from _decode_list(file, path)
    except JSONDecodeError as error:
        raise InputError(f"{path}: not JSON ({error.msg})") from None
    except InputError:
        raise
    except (IsADirectoryError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None


def _decode_list(file: TextIO, path: Path) -> Iterator[object]:
    """Yield the elements of a JSON list; an element is complete once what follows it has been read, too."""
    decoder, text, more = JSONDecoder(), "", CHUNK
    while (read := file.read(CHUNK)) and not (text := read.lstrip(BLANKS)):
        pass
    if not text.startswith("["):
        read_json(path)
        raise InputError(f"{path}: not a table of nuScenes; a list of rows is wanted")
    begin = True
    at = 1
    while True:
        try:
            end = _skip(text, at)
            if not begin or text[end : end + 1] != "]":  # an empty list
                element, end = decoder.raw_decode(text, end)
                end = _skip(text, end)
                if text[end : end + 1] not in (",", "]"):
                    raise JSONDecodeError("Expecting ',' delimiter", text, end)
                yield element
        except JSONDecodeError:  # the element may continue in what is not read yet
            if not (read := file.read(more)):
                raise
            text, at, more = text[at:] + read, 0, 2 * more
            continue
        if text[end] == "]":
            break
        begin, at, more = False, end + 1, CHUNK
    rest = text[end + 1 :]
    while not rest.strip(BLANKS) and (rest := file.read(CHUNK)):
        pass
    if rest:
        raise JSONDecodeError("Extra data", rest, 0)


def _skip(text: str, at: int) -> int:
    """Return the index of the next character that is not white space."""
    while at < len(text) and text[at] in BLANKS:
        at += 1
    return at


def _fits(column: str, value: object) -> bool:
    """Return whether a value is valid in a column of COLUMNS or OPTIONAL."""
    if column in NUMBERS:
        return _are_numbers(value, NUMBERS[column]) and (column != "rotation" or _has_length_1(value))
    if column == "camera_intrinsic":
        return value == [] or (isinstance(value, list) and len(value) == 3 and all(_are_numbers(r, 3) for r in value))
    if column == "modality":
        return value in MODALITIES
    if column == "timestamp":
        return isinstance(value, int)
    if column in ("width", "height"):
        return value is None or isinstance(value, int)
    if column == "attribute_tokens":
        return isinstance(value, list) and all(isinstance(token, str) for token in value)
    return isinstance(value, bool if column == "is_key_frame" else str)


def _has_length_1(quaternion: Any) -> bool:
    return abs(math.hypot(*quaternion) - 1) <= ROUNDED


def _are_numbers(values: object, count: int) -> bool:
    return (
        isinstance(values, list)
        and len(values) == count
        and all(isinstance(value, int | float) and abs(value) < FARTHEST for value in values)
    )
