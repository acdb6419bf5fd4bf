"""Study of the weather task: accuracy, recall and confusion matrices, within the classes' regions and everywhere."""

from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.study import Study, StudyResult, describe_limits, list_counts, make_experiment
from flcav.perception.weather.evaluate import Classification, evaluate_whole_space
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.task import WEATHER, WHOLE_SPACE
from flcav.report import style
from flcav.report.charts.studies import confusions
from flcav.statistics.estimates import Estimate, score_interval
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

WANTED = 0.95  # aim: least accuracy
EFFECT = 0.02  # deviation from an aim that the study should detect


def tables(results: StudyResult[Classification]) -> dict[str, str]:
    """Return Markdown by name: findings (a list), accuracy, recall, seeds."""
    return {
        "findings": format_bullets(_findings(results)),
        "accuracy": _accuracy(results),
        "recall": _recall(results),
        "seeds": _seeds(results),
    }


def _findings(results: StudyResult[Classification]) -> list[str]:
    aims = {}
    for test, numbers in results.summary.items():
        for name, mean in numbers.items():
            where = "within the classes' regions" if name == "accuracy" else "by the nearest class, everywhere"
            aims[f"Accuracy of {WANTED} on {test}, {where}"] = Claim(mean, WANTED)
    return [*describe_aims(aims), *describe_limits(aims.values(), EFFECT)]


def _accuracy(results: StudyResult[Classification]) -> str:
    rows = []
    for test, numbers in results.summary.items():
        tested = results.tested(test)
        for name, mean in numbers.items():
            tests = [found if name == "accuracy" else found.nearest or found for found in tested]
            over_scenes = ", ".join(_with_interval(one).describe() for one in tests)
            what = "within the regions" if name == "accuracy" else "everywhere, nearest class"
            counts = (list_counts([one.pictures for one in tests]), list_counts([one.scenes for one in tests]))
            rows.append([test, what, *counts, mean.describe(), over_scenes])
    header = ("test", "pictures", "number", "scenes", "accuracy, over seeds", "each seed, over its scenes")
    return format_table(header, rows)


def _with_interval(found: Classification) -> Estimate:
    """Return the accuracy with its interval over scenes: Wilson's where all scenes are alike, as at 0 and 1."""
    if found.low == found.high and found.low is not None:
        return score_interval(found.accuracy, found.scenes)
    return Estimate(found.accuracy, found.low, found.high)


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
    return format_table(("class", *(f"recall, {test} (taken for)" for test in tests)), rows)


def _seeds(results: StudyResult[Classification]) -> str:
    rows = []
    for seed in results.seeds:
        validated = Classification.from_json(seed.card.metrics, "card")
        rows.append([seed.seed, seed.card.samples, seed.card.learning.steps, f"{validated.accuracy:.3f}"])
    return format_table(("seed", "training pictures", "steps", "accuracy on validation"), rows)


def add_nearest(found: Classification, network: Classifier, data: Dataset) -> Classification:
    """Return the evaluation with that of all pictures, each labelled with the nearest class."""
    return replace(found, nearest=evaluate_whole_space(network, data))


def _draw(results: StudyResult[Classification]) -> bytes:
    """Return a PNG of the confusion matrix of each test, summed over seeds."""
    shown = {
        name: [evaluation.nearest or evaluation for evaluation in results.tested(name)] for name in results.summary
    }
    counts = {name: np.sum([result.confusion for result in found], axis=0) for name, found in shown.items()}
    return style.png(confusions(counts, next(iter(shown.values()))[0].classes))


def _is_share(name: str) -> bool:
    return True  # accuracies


STUDY = Study(
    WEATHER,
    WEATHER.study(),
    draw=_draw,
    extra={WHOLE_SPACE: add_nearest},
    is_share=_is_share,
)

EXPERIMENT = make_experiment(STUDY, tables)
