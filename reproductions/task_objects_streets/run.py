"""Study of the object task trained in streets that are drawn at random; otherwise as `task_objects`."""

from flcav.experiments.study import make_experiment
from flcav.reproductions.task_objects.run import STREETS, tables

EXPERIMENT = make_experiment(STREETS, tables)
