"""Wording of messages: suggestions for misspelt names, hints on units, printable text, plurals.

Optional dependencies: the packages of flcav's extras and the command that installs them.
"""

import re
import shlex
import sys
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from importlib.metadata import requires

AMOUNT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z%/]+)\s*")
UNITS: Mapping[str, Mapping[str, float]] = {  # by suffix of a field's name: factors from other units to the field's
    "mb": {"b": 1e-6, "kb": 1e-3, "mb": 1.0, "gb": 1e3, "tb": 1e6},
    "mbps": {"kbps": 1e-3, "mbps": 1.0, "gbps": 1e3, "kbit/s": 1e-3, "mbit/s": 1.0, "gbit/s": 1e3},
    "s": {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    "m": {"cm": 1e-2, "m": 1.0, "km": 1e3},
}
NAMES = {"mb": "MB", "mbps": "Mbit/s", "s": "s", "m": "m"}


def suggest(name: str, known: Iterable[str]) -> str:
    """Return " (did you mean 'suburb'?)" of the known name that is closest to `name`; "" where none is close."""
    close = get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def make_printable(text: str, most: int = 200) -> str:
    """Return untrusted text as one line that is safe to print, cut to `most` characters with an ellipsis.

    Control characters (escape sequences, line ends) and invisible ones (such as changes of writing direction) are
    escaped as in Python.

    >>> make_printable("well\\x1b[2J")
    'well\\\\x1b[2J'
    """
    line = escape_invisible(text[: most + 1])
    return line if len(line) <= most else f"{line[:most]} ..."


def escape_invisible(text: str, kept: str = "") -> str:
    """Return a text with its unprintable characters escaped as in Python, except those in `kept`.

    >>> escape_invisible("well\\x1b[2J")
    'well\\\\x1b[2J'
    """
    return "".join(letter if letter.isprintable() or letter in kept else ascii(letter)[1:-1] for letter in text)


def plural(number: int, noun: str) -> str:
    """Return "1 scene" or "2 scenes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def describe_megabytes(megabytes: float) -> str:
    """Return megabytes in words, with a decimal below one.

    >>> describe_megabytes(12.3), describe_megabytes(0.52)
    ('12 MB', '0.5 MB')
    """
    return f"{megabytes:.{1 if megabytes < 1 else 0}f} MB"


def describe_number(text: str, field: str) -> str:
    """Return the advice for a `text` that is no number: the number in the unit that the field's name ends with.

    >>> describe_number("2 GB", "budgets_mb.wireless")
    'must be a number of MB, without the unit: 2000'
    >>> describe_number("55 %", "accuracy")
    'must be a number, without the unit: 0.55'
    """
    match = AMOUNT.fullmatch(text)
    if match is None:
        return "must be a number"
    amount, unit = float(match[1]), match[2].lower()
    wanted = next((part.rsplit("_", 1)[1] for part in reversed(field.split(".")) if _unit_of(part)), None)
    if wanted is None and unit == "%":
        return f"must be a number, without the unit: {amount / 100:g}"
    if wanted is None:
        return "must be a number, without a unit"
    if unit not in UNITS[wanted]:
        return f"must be a number of {NAMES[wanted]}, without a unit"
    return f"must be a number of {NAMES[wanted]}, without the unit: {amount * UNITS[wanted][unit]:.10g}"


def _unit_of(part: str) -> bool:
    return "_" in part and part.rsplit("_", 1)[1] in UNITS


def hint_share(value: float) -> str:
    """Return the hint "; 55 % is 0.55" for a value that may be a percentage where a share is wanted, otherwise ""."""
    return f"; {value:g} % is {value / 100:g}" if 1 < value <= 100 else ""


def format_install_command(extra: str) -> str:
    """Return the pip command that installs the packages of flcav's `extra` into this Python environment."""
    lines = (line.partition(";") for line in requires("flcav") or ())
    wanted = f"extra == '{extra}'"  # a build back end may write either quotes
    packages = [package.strip() for package, _, condition in lines if wanted in condition.replace('"', "'")]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
