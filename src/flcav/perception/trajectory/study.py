"""Study recipes of the trajectory task: with rasters, and with cameras.

With rasters: training in two towns, tests on held-out scenes and on a held-out town, by recipes/trajectory.yaml,
trajectory_suburb.yaml and trajectory_ring.yaml. With cameras: training in one town, tests on held-out scenes of the
same town, by recipes/trajectory_cameras.yaml.
"""

from flcav.perception.study import StudyRecipe, read_recipe

GRID, SUBURB, RING = read_recipe("trajectory"), read_recipe("trajectory_suburb"), read_recipe("trajectory_ring")
TESTED = {"split": "test", "scenes": 10, "spins_per_scene": 41}  # 20 s of a scene
CAMERA_RECIPE = read_recipe("trajectory_cameras")

STUDY = StudyRecipe(
    network="tiny",
    train=(GRID, SUBURB),
    validation={**GRID, "seed": 121, "split": "validation", "scenes": 1},
    tests={
        "held-out scenes": {**GRID, "seed": 221, **TESTED},
        "held-out town": {**RING, **TESTED},
    },
    epochs=3,
    patience=3,
    quick_scenes=1,
)

CAMERAS = StudyRecipe(
    network="tiny-cameras",
    train=(CAMERA_RECIPE,),
    validation={**CAMERA_RECIPE, "seed": 131, "split": "validation", "cavs": 3, "scenes": 4},
    tests={"held-out scenes": {**CAMERA_RECIPE, **TESTED, "seed": 331, "cavs": 2}},
    epochs=5,
    patience=5,
    quick_scenes=1,
)
