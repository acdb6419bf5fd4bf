"""Resumable workflows of named steps: finished steps are kept, independent ones run in parallel."""

from flcav.runs.engine.run import run_side_by_side, run_steps, stopwatch
from flcav.runs.engine.step import FINISHED, STALE, WHOLE, Notify, Stale, Step, Work, ignore_steps, print_steps

__all__ = [
    "FINISHED",
    "STALE",
    "WHOLE",
    "Notify",
    "Stale",
    "Step",
    "Work",
    "ignore_steps",
    "print_steps",
    "run_side_by_side",
    "run_steps",
    "stopwatch",
]
