"""The study of the sign task: three towns to learn from; held-out scenes and a held-out town to test.

It learns from recipes/signs.yaml, signs_suburb.yaml and signs_grid.yaml.
The held-out scenes have all eight classes; the held-out town has speed limits of 30, yield signs and lights alone.
"""

from collections.abc import Mapping

from flcav.experiments.signs_tables import name_of
from flcav.experiments.task_study import Study, StudyResult, recipe_of
from flcav.perception.signs.evaluate import SignsEvaluation
from flcav.perception.signs.task import SIGNS
from flcav.report import style
from flcav.report.precision import Bar, precisions

ARTERIAL, SUBURB, GRID = recipe_of("signs"), recipe_of("signs_suburb"), recipe_of("signs_grid")
RING = {**ARTERIAL, "town": "ring", "warmup_s": [87.0, 89.5]}


def _numbers(found: SignsEvaluation) -> Mapping[str, float]:
    """Return mAP, and AP50 by class and by size, of what there was to find."""
    means = {"mAP50": found.map50, "mAP50-95": found.map50_95}
    classes = {name_of(row): row.ap50 for row in found.classes}
    sizes = {name_of(row): row.map50 for row in found.sizes}
    return {name: value for name, value in (means | classes | sizes).items() if value is not None}


def _draw(results: StudyResult[SignsEvaluation]) -> bytes:
    """Return a panel per test: AP50 of each class, of each size, and their mean."""
    panels = {}
    for test, means in results.summary.items():
        tested = results.tested(test)
        targets = {name_of(row): row.targets for row in (*tested[0].classes, *tested[0].sizes)}
        numbers = [_numbers(result) for result in tested]
        panels[test] = [
            Bar(name, means[name].mean, tuple(row[name] for row in numbers), targets.get(name))
            for name in numbers[0]
            if name in means and name != "mAP50-95"
        ]
    return style.png(precisions(panels))


STUDY = Study(
    task=SIGNS,
    network="n",
    train=(ARTERIAL, SUBURB, GRID),
    validation={**ARTERIAL, "seed": 114, "split": "validation", "scenes": 6},
    tests={
        "held-out scenes": {**ARTERIAL, "seed": 414, "split": "test", "scenes": 12},
        "held-out town": {**RING, "seed": 514, "split": "test", "scenes": 6},
    },
    epochs=15,
    patience=15,
    evaluation=SignsEvaluation,
    numbers=_numbers,
    draw=_draw,
)
