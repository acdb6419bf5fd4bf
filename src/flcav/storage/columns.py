"""Columns of a table by the names that people give them."""

import re
from collections.abc import Mapping, Sequence

from flcav.config import InputError

PERCENT = re.compile(r"_?(percentage|percent|pct)")
Cell = str | float | None
Columns = Mapping[str, Sequence[Cell]]  # by name


def find_columns(
    columns: Columns, names: Mapping[str, Sequence[str]], origin: str
) -> tuple[dict[str, Sequence[Cell]], tuple[str, ...]]:
    """Return a table with its columns renamed to the keys of `names`, and a sentence on each that had another name.

    names: other names of a column, in lower case, with underscores for whatever is neither a letter nor a digit: so
    "Training samples" is "training_samples". A column whose name says percent is divided by 100. Columns of unknown
    names stay. Raises `InputError`, naming `origin`, where two columns are one by their names.

    >>> find_columns({"N": [10], "Accuracy (%)": [50.0]}, {"samples": ["n"], "accuracy": []}, "curve.csv")
    ({'samples': [10], 'accuracy': [0.5]}, ("column 'N' is read as samples", "column 'Accuracy (%)' is read as ..."))
    """
    of = {other: name for name, others in names.items() for other in (name, *others)}
    found: dict[str, list[str]] = {}
    for title in columns:
        plain = _plain(title)
        found.setdefault(of.get(plain) or of.get(PERCENT.sub("", plain).strip("_")) or title, []).append(title)
    renamed: dict[str, Sequence[Cell]] = {}
    told = []
    for name, titles in found.items():
        if name in titles:  # further columns that could be this one are others
            renamed |= {title: columns[title] for title in titles}
            continue
        if len(titles) > 1:
            raise InputError(
                f"{origin}: columns {' and '.join(map(repr, titles))} are both {name}: call the one that counts {name}"
            )
        (title,) = titles
        shares = bool(PERCENT.search(_plain(title)))
        renamed[name] = [_share(value) for value in columns[title]] if shares else columns[title]
        told.append(f"column {title!r} is read as {name}{', divided by 100' * shares}")
    return renamed, tuple(told)


def _plain(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", title.replace("%", " percent ").lower()).strip("_")


def _share(value: Cell) -> Cell:
    return value / 100 if isinstance(value, int | float) else value
