"""Study recipes of the trajectory task: with rasters, and with cameras.

With rasters: training in two towns, tests on held-out scenes and on a held-out town, by recipes/trajectory.yaml,
trajectory_suburb.yaml and trajectory_ring.yaml. With cameras: training in one town, tests on held-out scenes of the
same town, by recipes/trajectory_cameras.yaml. Tests have seeds of their own, and new ones after a change that followed
a look at their results: seeds 221 and 25 (ring) were those of the first study with rasters.
"""

from flcav.perception.study import StudyRecipe, read_recipe

GRID, SUBURB, RING = read_recipe("trajectory"), read_recipe("trajectory_suburb"), read_recipe("trajectory_ring")
CAMERA_RECIPE = read_recipe("trajectory_cameras")

STUDY = StudyRecipe(
    network="tiny",
    train=(GRID, SUBURB),
    validation={**GRID, "seed": 121, "split": "validation", "scenes": 1},
    tests={
        "held-out scenes": {**GRID, "seed": 421, "split": "test", "scenes": 10},
        "held-out town": {**RING, "seed": 425, "split": "test", "scenes": 10},
    },
    epochs=3,
    patience=3,
    quick_scenes=1,
)

CAMERAS = StudyRecipe(
    network="tiny-cameras",
    train=(CAMERA_RECIPE,),
    validation={**CAMERA_RECIPE, "seed": 131, "split": "validation", "cavs": 3, "scenes": 4},
    tests={"held-out scenes": {**CAMERA_RECIPE, "seed": 331, "split": "test", "cavs": 2, "scenes": 10}},
    epochs=5,
    patience=5,
    quick_scenes=1,
)
