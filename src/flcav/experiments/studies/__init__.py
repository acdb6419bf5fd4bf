"""The studies of the tasks: every module here holds one, called `STUDY`, and gives it its name."""

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from flcav.plugins import load_own

if TYPE_CHECKING:
    from flcav.experiments.task_study import Study

STUDIES: tuple[str, ...] = tuple(sorted(found.name.replace("_", "-") for found in iter_modules(__path__)))


def study_named(name: str) -> "Study":
    """Return the study of that name, one of `STUDIES`, or somebody's own (`module:NAME`).

    Raises `InputError` where there is none.
    """
    if name in STUDIES:
        return import_module(f"{__name__}.{name.replace('-', '_')}").STUDY
    from flcav.experiments.task_study import Study

    return load_own("study", name, STUDIES, Study)
