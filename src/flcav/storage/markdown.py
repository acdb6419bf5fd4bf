"""Markdown tables, lists and signed numbers."""

from collections.abc import Iterable, Sequence


def format_table(header: Sequence[str], rows: Iterable[Sequence[str | float]]) -> str:
    """Return a Markdown table of `rows` below the column names in `header`."""
    lines = [f"| {' | '.join(map(str, line))} |" for line in (header, *rows)]
    lines.insert(1, "|" + "---|" * len(header))
    return "\n".join(line.replace("|  |", "| |") for line in lines)


def format_bullets(lines: Iterable[str]) -> str:
    """Return a Markdown bullet list of `lines`."""
    return "\n".join(f"- {line}" for line in lines)


def format_signed(value: float, digits: int = 3) -> str:
    """Return `value` with its sign (ASCII) and `digits` decimals."""
    return f"{value:+.{digits}f}"
