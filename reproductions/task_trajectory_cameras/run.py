"""Study of the trajectory task on pictures of cameras: `task_trajectory` with them in place of rasters."""

from flcav.experiments.study import make_experiment
from flcav.reproductions.task_trajectory.run import CAMERAS, tables

EXPERIMENT = make_experiment(CAMERAS, tables)
