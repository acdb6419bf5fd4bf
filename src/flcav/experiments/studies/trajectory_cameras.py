"""The study of the trajectory task through surround cameras."""

from flcav.experiments.studies.trajectory import CAMERAS as STUDY

__all__ = ["STUDY"]
