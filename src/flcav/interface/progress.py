"""Progress reporting: the callback type of long-running functions, and a progress bar on stderr."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int, str], None]  # done, total, note (e.g. "loss 0.31")
WIDTH = 79  # of the line
DAMAGED = "is damaged"  # in notes that stay on the terminal: a file failed its check and is made anew


def ignore_progress(done: int, total: int, note: str = "") -> None:
    """Do nothing: a `Report` without a display."""


def print_progress(done: int, total: int, note: str = "") -> None:
    """Print progress on one line of stderr, in a terminal or notebook only: the default `Report` of Python calls.

    A note that a file is damaged stays on a line of its own.
    """
    if not (sys.stderr.isatty() or "ipykernel" in sys.modules):
        return
    end = "\n" if done >= total or DAMAGED in note else ""
    sys.stderr.write(f"\r{f'{done}/{total} {note}'[:WIDTH]:<{WIDTH}}{end}")
    sys.stderr.flush()


@contextlib.contextmanager
def show_progress(title: str) -> Iterator[Report]:
    """Yield a `Report` that draws a progress bar with the estimated time left on stderr, if stderr is a terminal.

    The `done` of the first call was finished by an earlier run, and does not count towards the speed. A note that a
    file is damaged is always printed, even without a terminal.
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
