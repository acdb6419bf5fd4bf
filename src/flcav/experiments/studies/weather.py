"""The study of the weather task: three towns to learn from; other scenes, another town and the whole space to test.

The recipe is that of recipes/weather.yaml: each scene goes once through all eight classes, so that they are balanced.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.task_study import Study, StudyResult, recipe_of
from flcav.perception.weather.evaluate import Classification
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.task import WEATHER, over_the_whole_space
from flcav.report import style
from flcav.report.confusion import confusions
from flcav.world.weather import ANY

RECIPE = recipe_of("weather")
WHOLE_SPACE = "whole space"
ANY_WEATHER = {"classes": [ANY] * 8, "turn_s": 4.0}


def with_nearest(found: Classification, network: Classifier, data: Dataset) -> Classification:
    """Return the evaluation with that of all pictures besides, each of the nearest class."""
    return replace(found, nearest=over_the_whole_space(network, data))


def _numbers(found: Classification) -> Mapping[str, float]:
    """Return the accuracy on pictures within the classes' regions, and on all where the whole space was asked for."""
    nearest = {} if found.nearest is None else {"nearest class": found.nearest.accuracy}
    return {"accuracy": found.accuracy, **nearest}


def _draw(results: StudyResult[Classification]) -> bytes:
    """Return the confusion matrix of each test, the seeds' together."""
    shown = {name: [each.nearest or each for each in results.tested(name)] for name in results.summary}
    counts = {name: np.sum([result.confusion for result in found], axis=0) for name, found in shown.items()}
    return style.png(confusions(counts, next(iter(shown.values()))[0].classes))


STUDY = Study(
    task=WEATHER,
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
    evaluation=Classification,
    numbers=_numbers,
    draw=_draw,
    extra={WHOLE_SPACE: with_nearest},
)
