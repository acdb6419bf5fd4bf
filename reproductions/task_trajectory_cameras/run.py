"""Study of the trajectory task on camera pictures instead of rasters; otherwise as `task_trajectory`."""

from flcav.experiments.study import make_experiment
from flcav.reproductions.task_trajectory.run import CAMERAS, tables

EXPERIMENT = make_experiment(CAMERAS, tables)
