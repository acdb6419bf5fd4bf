"""The studies of the trajectory task, on rasters and through cameras: final errors are drawn by slice."""

from collections.abc import Sequence

import numpy as np

from flcav.experiments.task_study import Study, StudyResult
from flcav.perception.trajectory import study
from flcav.perception.trajectory.evaluate import PathErrors, TrajectoryEvaluation
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.report import style
from flcav.report.path_errors import Bar, path_errors


def _draw(results: StudyResult[TrajectoryEvaluation]) -> bytes:
    """Return final errors of each test and slice."""
    panels = {}
    for test in results.summary:
        slices: dict[str, list[PathErrors]] = {}
        for tested in results.tested(test):
            for name, errors in tested.slices.items():
                slices.setdefault(name, []).extend([errors] if errors else [])
        panels[test] = {
            f"{name}\n({seeds[0].samples})": [
                _bar("constant velocity", [each.constant_velocity_FDE for each in seeds]),
                _bar("single path", [each.single_FDE for each in seeds]),
                _bar("best of six modes", [each.minFDE_K for each in seeds]),
            ]
            for name, seeds in slices.items()
            if seeds
        }
    return style.png(path_errors(panels))


def _bar(name: str, seeds: Sequence[float | None]) -> Bar:
    known = [value for value in seeds if value is not None]
    return Bar(name, float(np.mean(known)), known)


STUDY = Study(TRAJECTORY, TRAJECTORY.study(), draw=_draw)
CAMERAS = Study(TRAJECTORY, study.CAMERAS, draw=_draw)
