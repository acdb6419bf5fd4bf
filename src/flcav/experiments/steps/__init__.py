"""An experiment as named steps that leave files: what is done stands, what is independent runs side by side."""

from flcav.experiments.steps.record import STALE
from flcav.experiments.steps.run import ENGINES, run_side_by_side, run_steps, stopwatch
from flcav.experiments.steps.step import FINISHED, Notify, Step, Work

__all__ = [
    "ENGINES",
    "FINISHED",
    "STALE",
    "Notify",
    "Step",
    "Work",
    "run_side_by_side",
    "run_steps",
    "stopwatch",
]
