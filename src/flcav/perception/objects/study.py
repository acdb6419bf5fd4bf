"""Study recipe of the object task: training in three towns, tests on other scenes of each, in weather and of tracking.

The sweeps are those of recipes/objects.yaml, in every town.
"""

from flcav.perception.study import StudyRecipe, read_recipe

RECIPE = read_recipe("objects")
TESTED = {**RECIPE, "split": "test", "scenes": 10, "spins_per_scene": 4}
SEQUENCES = {**TESTED, "spins_per_scene": 20, "every_s": 0.5, "cavs": 1}
TOWNS = ("suburb", "ring", "grid")
CHANGING = {"classes": ["clear", "light_rain", "heavy_rain", "fog"], "turn_s": 4.0}
WEATHERS = "weathers"
TRACKS = "tracks"

STUDY = StudyRecipe(
    network="small",
    train=tuple({**RECIPE, "town": town} for town in TOWNS),
    validation={**RECIPE, "town": "suburb", "seed": 121, "split": "validation", "scenes": 2},
    tests={
        **{town: {**TESTED, "town": town, "seed": 441} for town in TOWNS},
        WEATHERS: {**TESTED, "town": "suburb", "seed": 541, "weather": CHANGING},
        TRACKS: {**SEQUENCES, "town": "suburb", "seed": 641},
    },
    epochs=8,
    patience=8,
)

# Training in drawn streets, five of each town, beside a third of the sweeps of `STUDY`, whose cars have flat ends.
DRAWN = read_recipe("streets")
DRAWN_TEST = {**DRAWN, "split": "test", "scenes": 10}
STREETS_STUDY = StudyRecipe(
    network="small",
    train=(
        *({**RECIPE, "town": town, "scenes": 5} for town in TOWNS),
        *({**DRAWN, "town": town, "seed": seed} for town in TOWNS for seed in (23, 25, 27, 29, 31)),
    ),
    validation={**DRAWN, "town": "suburb", "seed": 123, "split": "validation", "scenes": 2},
    tests={
        **{town: {**TESTED, "town": town, "seed": 451} for town in TOWNS},
        "streets": {**DRAWN_TEST, "town": "suburb", "seed": 453},
        "streets-arterial": {**DRAWN_TEST, "town": "arterial", "seed": 455},
    },
    epochs=8,
    patience=8,
)
