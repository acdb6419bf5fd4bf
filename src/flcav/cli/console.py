"""Where commands print tables and lines in which names stand that users gave."""

from rich.console import Console


def plain_console() -> Console:
    """Return stdout's console; brackets and colons in what is printed are neither markup nor emoji."""
    return Console(highlight=False, markup=False, emoji=False)
