"""The tables on the page of the weather task's study, from its numbers."""

import numpy as np

from flcav.experiments.task_study import StudyResult
from flcav.intervals import Estimate
from flcav.markdown import bullets, table
from flcav.perception.weather.evaluate import Classification
from flcav.verdicts import aim_sentence

WANTED = 0.95  # accuracy


def tables(results: StudyResult[Classification]) -> dict[str, str]:
    """Return Markdown by name: findings, accuracy, recall, seeds."""
    return {
        "findings": bullets(_findings(results)),
        "accuracy": _accuracy(results),
        "recall": _recall(results),
        "seeds": _seeds(results),
    }


def _findings(results: StudyResult[Classification]) -> list[str]:
    said = []
    for test, numbers in results.summary.items():
        for name, mean in numbers.items():
            where = "within the classes' regions" if name == "accuracy" else "by the nearest class, everywhere"
            aim = f"Accuracy of {WANTED} on {test}, {where}"
            said.append(aim_sentence(aim, WANTED, mean, len(results.seeds)) + ".")
    return said


def _accuracy(results: StudyResult[Classification]) -> str:
    rows = []
    for test, numbers in results.summary.items():
        tested = results.tested(test)
        for name, mean in numbers.items():
            each = [found if name == "accuracy" else found.nearest or found for found in tested]
            over_scenes = ", ".join(Estimate(one.accuracy, one.low, one.high).told() for one in each)
            what = "within the regions" if name == "accuracy" else "everywhere, nearest class"
            rows.append([test, what, each[0].pictures, each[0].scenes, mean.told(), over_scenes])
    header = ("test", "pictures", "number", "scenes", "accuracy, over seeds", "each seed, over its scenes")
    return table(header, rows)


def _recall(results: StudyResult[Classification]) -> str:
    tests = [test for test in results.summary if results.tested(test)[0].nearest is None]
    classes = results.tested(tests[0])[0].classes
    rows = []
    for number, name in enumerate(classes):
        cells = []
        for test in tests:
            matrix = np.sum([found.confusion for found in results.tested(test)], axis=0)[number]
            others = {classes[i]: int(matrix[i]) for i in np.argsort(-matrix, kind="stable") if i != number}
            taken = ", ".join(f"{other} {count}" for other, count in others.items() if count)
            cells.append(f"{matrix[number] / matrix.sum():.3f}" + (f" ({taken})" if taken else ""))
        rows.append([name, *cells])
    return table(("class", *(f"recall, {test} (taken for)" for test in tests)), rows)


def _seeds(results: StudyResult[Classification]) -> str:
    rows = []
    for seed in results.seeds:
        validated = Classification.of_json(seed.card.metrics, "card")
        rows.append([seed.seed, seed.card.samples, seed.card.learning.steps, f"{validated.accuracy:.3f}"])
    return table(("seed", "training pictures", "steps", "accuracy on validation"), rows)
