"""Terminal output: a plain console, live progress of steps, and messages for Ctrl-C."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from flcav.pipeline.steps import FINISHED, Notify


def plain_console() -> Console:
    """Return a console on stdout without markup and emoji, since users' names may hold brackets and colons."""
    return Console(highlight=False, markup=False, emoji=False)


GOES_ON = "the same command goes on where it stopped"


class Interrupted(Exception):
    """Raised for Ctrl-C; the message says what is kept of the work."""


@contextlib.contextmanager
def when_interrupted(kept: Callable[[], str] = lambda: GOES_ON) -> Iterator[None]:
    """Turn Ctrl-C within the context into `Interrupted` with the message of `kept`; Typer only sets an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(kept()) from None


@contextlib.contextmanager
def live_steps(title: str) -> Iterator[Notify]:
    """Yield a `Notify` that draws one bar per running step; without a terminal, one line per finished step."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        whole = bars.add_task(title, total=None, note="")
        rows: dict[str, TaskID] = {}
        finished = 0

        def notify(step: str, done: int, total: int, note: str) -> None:
            nonlocal finished
            if step not in rows:
                rows[step] = bars.add_task(f"  {step}", total=None, note="")
            bars.update(rows[step], completed=done, total=max(total, 1), note=note)
            if note in FINISHED:
                finished += 1
                bars.update(rows[step], visible=False)
                bars.update(whole, note=f"{finished} steps done, {step} {note}")
                if not console.is_terminal:
                    console.print(f"{title}: {step} {note}", highlight=False)

        yield notify
