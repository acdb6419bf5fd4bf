"""The studies of the trajectory task: on rasters, and through cameras.

On rasters two towns are learned from, and held-out scenes and a held-out town tested; the recipes are those of
recipes/trajectory.yaml, trajectory_suburb.yaml and trajectory_ring.yaml. Through cameras it is one town and its
held-out scenes, by recipes/trajectory_cameras.yaml.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.experiments.task_study import RecipeFields, Result, Study
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.report import style
from flcav.report.path_errors import Bar, path_errors

RECIPE: RecipeFields = {
    "warmup_s": 60.0,
    "spins_per_scene": 81,
    "every_s": 0.5,
    "cavs": 1,
    "vehicle_rig": {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 4, "azimuth_steps": 90}}}},
}
YAWS_DEG = {"front": 0.0, "front_left": 60.0, "front_right": -60.0, "back_left": 120.0, "back_right": -120.0}
CAMERA_RECIPE: RecipeFields = RECIPE | {
    "warmup_s": [40.0, 120.0],
    "spins_per_scene": 41,
    "cavs": 4,
    "vehicle_rig": {
        "cameras": {
            name: {"mount": {"z": 1.7, "yaw_deg": yaw_deg}, "settings": {"width": 96, "height": 48, "fov_deg": 64.0}}
            for name, yaw_deg in (YAWS_DEG | {"back": 180.0}).items()
        }
    },
}
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
    train=(
        {**RECIPE, "town": "grid", "seed": 21, "scenes": 6},
        {**RECIPE, "town": "suburb", "seed": 24, "scenes": 5},
    ),
    validation={**RECIPE, "town": "grid", "seed": 121, "split": "validation", "scenes": 1},
    tests={
        "held-out scenes": {**RECIPE, "town": "grid", "seed": 221, "split": "test", "scenes": 3},
        "held-out town": {**RECIPE, "town": "ring", "seed": 25, "split": "test", "scenes": 3},
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
    train=({**CAMERA_RECIPE, "town": "grid", "seed": 31, "scenes": 24},),
    validation={**CAMERA_RECIPE, "town": "grid", "seed": 131, "split": "validation", "cavs": 3, "scenes": 4},
    tests={"held-out scenes": {**CAMERA_RECIPE, "town": "grid", "seed": 331, "split": "test", "cavs": 3, "scenes": 6}},
    epochs=5,
    patience=5,
    numbers=_numbers,
    draw=_draw,
    quick_scenes=1,
)
