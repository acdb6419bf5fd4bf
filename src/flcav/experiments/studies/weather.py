"""The study of the weather task: the whole space is tested by the nearest class besides; confusions are drawn."""

from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.task_study import Study, StudyResult
from flcav.perception.weather.evaluate import Classification
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.study import WHOLE_SPACE
from flcav.perception.weather.task import WEATHER, over_the_whole_space
from flcav.report import style
from flcav.report.confusion import confusions


def with_nearest(found: Classification, network: Classifier, data: Dataset) -> Classification:
    """Return the evaluation with that of all pictures besides, each of the nearest class."""
    return replace(found, nearest=over_the_whole_space(network, data))


def _draw(results: StudyResult[Classification]) -> bytes:
    """Return the confusion matrix of each test, the seeds' together."""
    shown = {name: [each.nearest or each for each in results.tested(name)] for name in results.summary}
    counts = {name: np.sum([result.confusion for result in found], axis=0) for name, found in shown.items()}
    return style.png(confusions(counts, next(iter(shown.values()))[0].classes))


STUDY = Study(WEATHER, WEATHER.study(), draw=_draw, extra={WHOLE_SPACE: with_nearest})
