"""The studies of the tasks, by name."""

from flcav.experiments.studies import objects, signs, trajectory, weather
from flcav.experiments.task_study import Study

STUDIES: dict[str, Study] = {
    study.task.name: study for study in (weather.STUDY, signs.STUDY, objects.STUDY, trajectory.STUDY)
}
STUDIES["trajectory-cameras"] = trajectory.CAMERAS
