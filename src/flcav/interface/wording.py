"""Wording of messages: names that were probably meant, numbers without their units, plurals of counts.

Optional dependencies: the packages of flcav's extras and the command that installs them.
"""

import re
import shlex
import sys
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from importlib.metadata import requires

AMOUNT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z%/]+)\s*")
UNITS: Mapping[str, Mapping[str, float]] = {  # by the ending of a field's name: what one of a unit is in its own
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
    """Return a text of somebody else as one line for a terminal, of `most` characters and an ellipsis.

    Control characters, such as escape sequences and line ends, and invisible ones, such as changes of the direction of
    writing, are shown as Python escapes them.

    >>> make_printable("well\\x1b[2J")
    'well\\\\x1b[2J'
    """
    line = escape_invisible(text[: most + 1])
    return line if len(line) <= most else f"{line[:most]} ..."


def escape_invisible(text: str, kept: str = "") -> str:
    """Return a text in which characters that cannot be seen, but for those of `kept`, are shown as Python escapes them.

    >>> escape_invisible("well\\x1b[2J")
    'well\\\\x1b[2J'
    """
    return "".join(each if each.isprintable() or each in kept else ascii(each)[1:-1] for each in text)


def plural(number: int, noun: str) -> str:
    """Return "1 scene" or "2 scenes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def describe_number(text: str, field: str) -> str:
    """Return what to write in place of a `text` that is no number, in the unit that the name of its field ends with.

    >>> describe_number("2 GB", "budgets_mb.wireless")
    'must be a number of MB, without the unit: 2000'
    >>> describe_number("55 %", "accuracy")
    'must be a number, without the unit: 0.55'
    """
    found = AMOUNT.fullmatch(text)
    if found is None:
        return "must be a number"
    amount, unit = float(found[1]), found[2].lower()
    own = next((part.rsplit("_", 1)[1] for part in reversed(field.split(".")) if _unit_of(part)), None)
    if own is None and unit == "%":
        return f"must be a number, without the unit: {amount / 100:g}"
    if own is None:
        return "must be a number, without a unit"
    if unit not in UNITS[own]:
        return f"must be a number of {NAMES[own]}, without a unit"
    return f"must be a number of {NAMES[own]}, without the unit: {amount * UNITS[own][unit]:.10g}"


def _unit_of(part: str) -> bool:
    return "_" in part and part.rsplit("_", 1)[1] in UNITS


def hint_share(value: float) -> str:
    """Return "; 55 % is 0.55" of a value that is too large for a share, and may be a percentage; "" of others."""
    return f"; {value:g} % is {value / 100:g}" if 1 < value <= 100 else ""


def format_install_command(extra: str) -> str:
    """Return the pip command that installs the packages of `extra`, as flcav's metadata list them, for this Python."""
    lines = (line.partition(";") for line in requires("flcav") or ())
    wanted = f"extra == '{extra}'"  # a build back end may write either quotes
    packages = [package.strip() for package, _, condition in lines if wanted in condition.replace('"', "'")]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
