"""Live progress of a run's steps on the terminal."""

import contextlib
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from flcav.federation.state import FAILED
from flcav.interface.progress import DAMAGED
from flcav.interface.wording import plural
from flcav.runs.engine import FINISHED, WHOLE, Notify
from flcav.runs.rigs import RIG

EPSILON = "epsilon"  # in the notes of rounds with differential privacy


@contextlib.contextmanager
def live_steps(title: str) -> Iterator[Notify]:
    """Yield a `Notify` that draws a bar of all steps, with the time left, and one per running step.

    Without a terminal it prints a line per finished step.
    """
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

        def notify(step: str, done: int, total: int, note: str) -> None:
            if step == WHOLE:
                counted = f"{done} of {plural(total, 'step')}"
                bars.update(whole, completed=done, total=total, note=f"{counted}, {note}" if note else counted)
                return
            if step == RIG:  # no step: a difference between the run's rig and the recorded one, which stays visible
                console.print(f"{title}: {note}", highlight=False)
                return
            if step not in rows:
                rows[step] = bars.add_task(f"  {step}", total=None, note="")
            bars.update(rows[step], completed=done, total=max(total, 1), note=note)
            if EPSILON in note or FAILED in note:  # privacy loss and failed clients of a round stay visible
                line = f"{title}: {step}, round {done} of {total}: {note}"
                console.print(line, highlight=False, soft_wrap=True)
            if DAMAGED in note:
                console.print(f"{title}: {step}: {note}", highlight=False, markup=False, soft_wrap=True)
            if note in FINISHED:
                bars.update(rows[step], visible=False)
                if not console.is_terminal:
                    console.print(f"{title}: {step} {note}", highlight=False)

        yield notify
