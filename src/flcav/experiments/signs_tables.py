"""The tables on the page of the sign task's study."""

from collections.abc import Sequence

from flcav.experiments.task_study import StudyResult, training_rows
from flcav.markdown import bullets, table
from flcav.perception.signs.evaluate import ClassPrecision, SignsEvaluation, SizePrecision
from flcav.verdicts import aim_sentence

WANTED = 0.75  # mAP50 on scenes that were not learned from


def tables(results: StudyResult[SignsEvaluation]) -> dict[str, str]:
    """Return the page's tables by name, from what `run_study` returned."""
    tested = [results.tested(test) for test in results.summary]
    return {
        "findings": bullets(_findings(results)),
        "classes": table(
            ("class", *_heads(results)),
            _rows([[found.classes for found in seeds] for seeds in tested]),
        ),
        "sizes": table(
            ("root of the box's area", *_heads(results)),
            _rows([[found.sizes for found in seeds] for seeds in tested]),
        ),
        "training": table(
            ("seed", "pictures", "steps", "validation mAP50 after each epoch; the network of the best is kept"),
            training_rows(results),
        ),
    }


def _findings(results: StudyResult[SignsEvaluation]) -> list[str]:
    seeds = len(results.seeds)
    said = []
    for test, means in results.summary.items():
        aim = aim_sentence(f"mAP50 of {WANTED} on {test}", WANTED, means["mAP50"], seeds)
        said.append(f"{aim}; mAP50-95 {means['mAP50-95'].mean:.3f}.")
    return said


def _heads(results: StudyResult[SignsEvaluation]) -> list[str]:
    return [head for test in results.summary for head in (f"{test}: to find", "AP50")]


def _rows(tests: Sequence[Sequence[Sequence[ClassPrecision | SizePrecision]]]) -> list[list[str]]:
    """Return a row per class or size; `tests`: of each test, of each seed, their average precision."""
    rows = []
    for number, named in enumerate(tests[0][0]):
        row = [named.name]
        for seeds in tests:
            own = [rows[number] for rows in seeds]
            known = [value for each in own if (value := _precision(each)) is not None]
            row += [str(own[0].targets), f"{sum(known) / len(known):.3f}" if known else ""]
        rows.append(row)
    return rows


def _precision(row: ClassPrecision | SizePrecision) -> float | None:
    return row.ap50 if isinstance(row, ClassPrecision) else row.map50
