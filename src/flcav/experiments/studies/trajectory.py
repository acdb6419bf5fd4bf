"""The studies of the trajectory task: on rasters, and through cameras.

On rasters two towns are learned from, and held-out scenes and a held-out town tested; the recipes are those of
recipes/trajectory.yaml, trajectory_suburb.yaml and trajectory_ring.yaml. Through cameras it is one town and its
held-out scenes, by recipes/trajectory_cameras.yaml.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.experiments.task_study import Result, Study, recipe_of
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.report import style
from flcav.report.path_errors import Bar, path_errors

GRID, SUBURB, RING = recipe_of("trajectory"), recipe_of("trajectory_suburb"), recipe_of("trajectory_ring")
CAMERA_RECIPE = recipe_of("trajectory_cameras")
PREDICTORS = {
    "constant velocity": "constant_velocity_FDE",
    "single path": "single_FDE",
    "best of six modes": "minFDE_K",
}
JUNCTIONS = "at junctions"


def _numbers(result: Result) -> Mapping[str, float]:
    """Return errors, misses and ratios to constant velocity of each slice that has samples."""
    return {
        f"{name}, {key}": value
        for name, numbers in result["slices"].items()
        if numbers is not None
        for key, value in numbers.items()
        if value is not None
    }


def _draw(results: Mapping[str, Any]) -> bytes:
    """Return final errors of each test and slice."""
    panels = {}
    for test in results["summary"]:
        tested = [seed["tests"][test]["slices"] for seed in results["seeds"]]
        panels[test] = {
            f"{name}\n({numbers['samples']})": [
                _bar(label, [one[name][key] for one in tested]) for label, key in PREDICTORS.items()
            ]
            for name, numbers in tested[0].items()
            if numbers is not None
        }
    return style.png(path_errors(panels))


def _bar(name: str, seeds: list[float]) -> Bar:
    return Bar(name, float(np.mean(seeds)), seeds)


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
    numbers=_numbers,
    draw=_draw,
    quick_scenes=1,
)
