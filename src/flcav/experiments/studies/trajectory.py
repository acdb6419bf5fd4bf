"""The studies of the trajectory task: on rasters, and through cameras.

On rasters two towns are learned from, and held-out scenes and a held-out town tested; the recipes are those of
recipes/trajectory.yaml, trajectory_suburb.yaml and trajectory_ring.yaml. Through cameras it is one town and its
held-out scenes, by recipes/trajectory_cameras.yaml.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from flcav.experiments.task_study import Study, StudyResult, recipe_of
from flcav.perception.trajectory.evaluate import PathErrors, TrajectoryEvaluation
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.report import style
from flcav.report.path_errors import Bar, path_errors

GRID, SUBURB, RING = recipe_of("trajectory"), recipe_of("trajectory_suburb"), recipe_of("trajectory_ring")
CAMERA_RECIPE = recipe_of("trajectory_cameras")


def _numbers(found: TrajectoryEvaluation) -> Mapping[str, float]:
    """Return errors, misses and ratios to constant velocity of each slice that has samples."""
    return {
        f"{name}, {key}": value
        for name, errors in found.slices.items()
        if errors is not None
        for key, value in vars(errors).items()
        if value is not None
    }


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


STUDY = Study(
    task=TRAJECTORY,
    network="tiny",
    train=(GRID, SUBURB),
    validation={**GRID, "seed": 121, "split": "validation", "scenes": 1},
    tests={
        "held-out scenes": {**GRID, "seed": 221, "split": "test", "scenes": 3},
        "held-out town": {**RING, "split": "test"},
    },
    epochs=3,
    patience=3,
    evaluation=TrajectoryEvaluation,
    numbers=_numbers,
    draw=_draw,
    quick_scenes=1,
)

CAMERAS = Study(
    task=TRAJECTORY,
    network="tiny-cameras",
    train=(CAMERA_RECIPE,),
    validation={**CAMERA_RECIPE, "seed": 131, "split": "validation", "cavs": 3, "scenes": 4},
    tests={"held-out scenes": {**CAMERA_RECIPE, "seed": 331, "split": "test", "cavs": 3, "scenes": 6}},
    epochs=5,
    patience=5,
    evaluation=TrajectoryEvaluation,
    numbers=_numbers,
    draw=_draw,
    quick_scenes=1,
)
