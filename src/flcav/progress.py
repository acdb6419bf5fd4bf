"""Progress reporting: the callback type of long-running functions, and a progress bar on stderr."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int, str], None]  # done, total, note (e.g. "loss 0.31")
DAMAGED = "is damaged"  # in notes that stay on the terminal: a file is not what was written, and is made anew


def ignore_progress(done: int, total: int, note: str = "") -> None:
    """Do nothing: the default `Report`, without a display."""


@contextlib.contextmanager
def show_progress(title: str) -> Iterator[Report]:
    """Yield a `Report` that draws a progress bar with the estimated time left on stderr, if stderr is a terminal.

    The `done` of the first call is taken as finished earlier and does not count towards the speed. A note that a file
    is damaged is printed, with a terminal and without.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[count]}", markup=False),  # nothing until the total is known
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task(title, total=None, note="", count="")
        begun = False

        def report(done: int, total: int, note: str = "") -> None:
            nonlocal begun
            if not begun:
                bars.reset(task, completed=done, total=total)
                begun = True
            bars.update(task, completed=done, total=total, note=note, count=f"{done}/{total}")
            if DAMAGED in note:
                console.print(f"{title}: {note}", highlight=False, markup=False, soft_wrap=True)

        yield report
