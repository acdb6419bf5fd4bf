"""Study recipe of the weather task: training in three towns, tests on held-out scenes, a held-out town, any weather.

Recordings are by recipes/weather.yaml: each scene goes once through all eight classes, so that they are balanced. The
test "whole space" draws weathers from the whole space of parameters, also between the classes' regions.
"""

from flcav.perception.study import StudyRecipe, read_recipe
from flcav.world.weather import ANY

RECIPE = read_recipe("weather")
WHOLE_SPACE = "whole space"
ANY_WEATHER = {"classes": [ANY] * 8, "turn_s": 4.0}

STUDY = StudyRecipe(
    network="tiny",
    train=(RECIPE, {**RECIPE, "town": "suburb", "seed": 113}, {**RECIPE, "town": "arterial", "seed": 613}),
    validation={**RECIPE, "seed": 213, "split": "validation", "scenes": 20},
    tests={
        "held-out scenes": {**RECIPE, "seed": 1013, "split": "test", "scenes": 12},
        "held-out town": {**RECIPE, "town": "grid", "seed": 1113, "split": "test", "scenes": 12},
        WHOLE_SPACE: {**RECIPE, "seed": 1213, "split": "test", "scenes": 12, "weather": ANY_WEATHER},
    },
    epochs=60,
    patience=15,
)
