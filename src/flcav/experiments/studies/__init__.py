"""Registry of the tasks' studies: those of the package by name, and users' own as `module:NAME`.

What is recorded, trained and tested is in `flcav.perception.study`; the modules here draw and tabulate the results.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from flcav.config import InputError
from flcav.plugins import load_named

if TYPE_CHECKING:
    from flcav.experiments.studies.run import Study, StudyResult

STUDIES: Mapping[str, str] = {  # name -> module:NAME, so that listing them loads none
    "objects": "flcav.experiments.studies.objects:STUDY",
    "objects-streets": "flcav.experiments.studies.objects:STREETS",
    "signs": "flcav.experiments.studies.signs:STUDY",
    "trajectory": "flcav.experiments.studies.trajectory:STUDY",
    "trajectory-cameras": "flcav.experiments.studies.trajectory:CAMERAS",
    "weather": "flcav.experiments.studies.weather:STUDY",
}


def study_named(name: str) -> "Study":
    """Return a study: one of `STUDIES`, or for `module:NAME` a user's own study, or the study of a user's own task.

    Raises `InputError` where there is none.
    """
    from flcav.experiments.studies.run import Study
    from flcav.perception.study import Studied
    from flcav.perception.task import Task

    own = load_named("study", name, STUDIES, object)
    if isinstance(own, Study):
        return own
    if not isinstance(own, Studied):
        raise InputError(f"study '{name}': is neither a study nor a task with a study()")
    task = load_named("task", name, {}, Task)
    return Study(task, own.study(), draw=draw_numbers)


def draw_numbers(results: "StudyResult") -> bytes:
    """Return a PNG with a panel per test: the mean over seeds of each number as a bar, each seed as a dot."""
    from flcav.report import style
    from flcav.report.charts.studies import Bar, precisions

    panels = {
        test: [
            Bar(name, mean.mean, tuple(found.numbers()[name] for found in results.tested(test)))
            for name, mean in means.items()
        ]
        for test, means in results.summary.items()
    }
    return style.png(precisions(panels, label="mean over seeds"))
