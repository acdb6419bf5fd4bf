"""Study of the object task in streets that are drawn at random: `task_objects` with other training recordings."""

from flcav.experiments.study import make_experiment
from flcav.reproductions.task_objects.run import STREETS, tables

EXPERIMENT = make_experiment(STREETS, tables)
