"""An experiment as named steps that leave files: what is done stands, what is independent runs side by side."""

from flcav.pipeline.steps.run import ENGINES, run_side_by_side, run_steps, stopwatch
from flcav.pipeline.steps.step import FINISHED, STALE, Notify, Stale, Step, Work

__all__ = [
    "ENGINES",
    "FINISHED",
    "STALE",
    "Notify",
    "Stale",
    "Step",
    "Work",
    "run_side_by_side",
    "run_steps",
    "stopwatch",
]
