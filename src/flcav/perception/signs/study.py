"""Study recipe of the sign task: training in three towns, tests on held-out scenes and on a held-out town.

Training recordings are by recipes/signs.yaml, signs_suburb.yaml and signs_grid.yaml. The held-out scenes have all eight
classes; the held-out town has only speed limits of 30, yield signs and lights.
"""

from flcav.perception.study import StudyRecipe, read_recipe

ARTERIAL, SUBURB, GRID = read_recipe("signs"), read_recipe("signs_suburb"), read_recipe("signs_grid")
RING = {**ARTERIAL, "town": "ring", "warmup_s": [87.0, 89.5]}

STUDY = StudyRecipe(
    network="n",
    train=(ARTERIAL, SUBURB, GRID),
    validation={**ARTERIAL, "seed": 114, "split": "validation", "scenes": 6},
    tests={
        "held-out scenes": {**ARTERIAL, "seed": 414, "split": "test", "scenes": 12},
        "held-out town": {**RING, "seed": 514, "split": "test", "scenes": 10},
    },
    epochs=15,
    patience=15,
)
