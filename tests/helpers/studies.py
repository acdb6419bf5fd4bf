"""The tasks' studies that come with flcav, by name."""

from collections.abc import Mapping
from typing import Any

from flcav.experiments.study import Study
from flcav.reproductions.task_objects import run as objects
from flcav.reproductions.task_road import run as road
from flcav.reproductions.task_signs import run as signs
from flcav.reproductions.task_trajectory import run as trajectory
from flcav.reproductions.task_weather import run as weather

STUDIES: Mapping[str, Study[Any]] = {
    "objects": objects.STUDY,
    "objects-streets": objects.STREETS,
    "road": road.STUDY,
    "signs": signs.STUDY,
    "trajectory": trajectory.STUDY,
    "trajectory-cameras": trajectory.CAMERAS,
    "weather": weather.STUDY,
}
