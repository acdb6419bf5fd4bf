"""Resumable workflows of named steps: finished steps are kept, independent ones run in parallel."""

from flcav.pipeline.engine.run import run_side_by_side, run_steps, stopwatch
from flcav.pipeline.engine.step import FINISHED, STALE, Notify, Stale, Step, Work, ignore_steps, print_steps

__all__ = [
    "FINISHED",
    "STALE",
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
