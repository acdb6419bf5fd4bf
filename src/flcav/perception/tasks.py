"""Registry of the perception tasks: `TASKS` lists those of the package; a user's is `module:NAME`.

>>> from flcav import TASKS
>>> list(TASKS)
['weather', 'signs', 'objects', 'trajectory', 'road']
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from flcav.plugins import load_named

if TYPE_CHECKING:
    from flcav.perception.task import Task

TASKS: Mapping[str, str] = {  # name -> module:NAME, so that listing the tasks imports none
    "weather": "flcav.perception.weather.task:WEATHER",
    "signs": "flcav.perception.signs.task:SIGNS",
    "objects": "flcav.perception.objects.task:OBJECTS",
    "trajectory": "flcav.perception.trajectory.task:TRAJECTORY",
    "road": "flcav.perception.road.task:ROAD",
}


def task_named(name: str) -> "Task":
    """Return the task of that name: one in `TASKS`, or a user's as `module:NAME`.

    Raises `InputError` for an unknown name, and where the user's module is missing or has no task of that name.

    >>> from flcav import task_named
    >>> list(task_named("objects").configurations)  # networks, the default first
    ['pillars', 'tiny', 'small', 'road', 'paper', 'pillars_far', 'pillars_radar', 'pillars_painted']
    """
    from flcav.perception.task import Task

    return load_named("task", name, TASKS, Task)
