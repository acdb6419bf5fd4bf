"""Study of the sign task: COCO's AP50 by class and by size of the sign."""

from collections.abc import Sequence

import numpy as np

from flcav.experiments.study import Study, StudyResult, describe_limits, list_counts, make_experiment, training_rows
from flcav.perception.signs.evaluate import ClassPrecision, SignsEvaluation, SizePrecision
from flcav.perception.signs.task import SIGNS
from flcav.report import style
from flcav.report.charts.studies import Bar, precisions
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

WANTED = 0.75  # aim: least mAP50 on other scenes
EFFECT = 0.05  # deviation from an aim that the study should detect


def tables(results: StudyResult[SignsEvaluation]) -> dict[str, str]:
    """Return Markdown by name: findings (a list), classes, sizes, training."""
    tested = [results.tested(test) for test in results.summary]
    return {
        "findings": format_bullets(_findings(results)),
        "classes": format_table(
            ("class", *_heads(results)),
            _rows([[found.classes for found in seeds] for seeds in tested]),
        ),
        "sizes": format_table(
            ("root of the box's area", *_heads(results)),
            _rows([[found.sizes for found in seeds] for seeds in tested]),
        ),
        "training": format_table(
            ("seed", "pictures", "steps", "validation mAP50 after each epoch; the network of the best is kept"),
            training_rows(results),
        ),
    }


def _findings(results: StudyResult[SignsEvaluation]) -> list[str]:
    aims = {f"mAP50 of {WANTED} on {test}": Claim(means["mAP50"], WANTED) for test, means in results.summary.items()}
    finer = (means["mAP50-95"].mean for means in results.summary.values())
    said = [f"{aim} mAP50-95 {mean:.3f}." for aim, mean in zip(describe_aims(aims), finer, strict=True)]
    return [*said, *describe_limits(aims.values(), EFFECT)]


def _heads(results: StudyResult[SignsEvaluation]) -> list[str]:
    return [head for test in results.summary for head in (f"{test}: targets", "AP50")]


def _rows(tests: Sequence[Sequence[Sequence[ClassPrecision | SizePrecision]]]) -> list[list[str]]:
    """Return a row per class or size with the mean AP over seeds; `tests`: by test and seed."""
    rows = []
    for number, named in enumerate(tests[0][0]):
        row = [named.name]
        for seeds in tests:
            by_seed = [rows[number] for rows in seeds]
            known = [value for score in by_seed if (value := _precision(score)) is not None]
            row += [
                list_counts([score.targets for score in by_seed]),
                f"{sum(known) / len(known):.3f}" if known else "",
            ]
        rows.append(row)
    return rows


def _precision(row: ClassPrecision | SizePrecision) -> float | None:
    return row.ap50 if isinstance(row, ClassPrecision) else row.map50


def _draw(results: StudyResult[SignsEvaluation]) -> bytes:
    """Return a PNG with a panel per test: AP50 by class and by size, with the mean number of targets, and mAP50."""
    panels = {}
    for test, means in results.summary.items():
        tested = results.tested(test)
        counts: dict[str, list[int]] = {}
        for row in (row for evaluation in tested for row in (*evaluation.classes, *evaluation.sizes)):
            counts.setdefault(row.name, []).append(row.targets)
        targets = {name: round(np.mean(counts_of_class)) for name, counts_of_class in counts.items()}
        numbers = [result.numbers() for result in tested]
        panels[test] = [
            Bar(name, means[name].mean, tuple(row[name] for row in numbers), targets.get(name))
            for name in numbers[0]
            if name in means and name != "mAP50-95"
        ]
    return style.png(precisions(panels))


def _is_share(name: str) -> bool:
    return True  # average precisions


STUDY = Study(SIGNS, SIGNS.study(), draw=_draw, is_share=_is_share)

EXPERIMENT = make_experiment(STUDY, tables)
