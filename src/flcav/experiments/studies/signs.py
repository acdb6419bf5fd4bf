"""The study of the sign task: AP50 is drawn by class and by size."""

from flcav.experiments.task_study import Study, StudyResult
from flcav.perception.signs.evaluate import SignsEvaluation
from flcav.perception.signs.task import SIGNS
from flcav.report import style
from flcav.report.precision import Bar, precisions


def _draw(results: StudyResult[SignsEvaluation]) -> bytes:
    """Return a panel per test: AP50 of each class, of each size, and their mean."""
    panels = {}
    for test, means in results.summary.items():
        tested = results.tested(test)
        targets = {row.name: row.targets for row in (*tested[0].classes, *tested[0].sizes)}
        numbers = [result.numbers() for result in tested]
        panels[test] = [
            Bar(name, means[name].mean, tuple(row[name] for row in numbers), targets.get(name))
            for name in numbers[0]
            if name in means and name != "mAP50-95"
        ]
    return style.png(precisions(panels))


STUDY = Study(SIGNS, SIGNS.study(), draw=_draw)
