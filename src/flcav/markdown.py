"""Numbers as Markdown."""

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str | float]]) -> str:
    """Return a table of `rows` below `header`."""
    lines = [f"| {' | '.join(map(str, line))} |" for line in (header, *rows)]
    lines.insert(1, "|" + "---|" * len(header))
    return "\n".join(line.replace("|  |", "| |") for line in lines)


def bullets(lines: Iterable[str]) -> str:
    """Return a list of `lines`."""
    return "\n".join(f"- {line}" for line in lines)


def signed(value: float, digits: int = 3) -> str:
    """Return the number with its sign."""
    return f"{value:+.{digits}f}"
