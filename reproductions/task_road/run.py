"""Study of the road task: F1 of lane lines by CULane's rule, IoU by class, errors on the ground, by condition."""

from collections.abc import Callable, Sequence

from flcav.experiments.study import Study, StudyResult, describe_limits, make_experiment, training_rows
from flcav.perception.road.evaluate import RoadEvaluation
from flcav.perception.road.task import ROAD
from flcav.report import style
from flcav.report.charts.studies import Bar, precisions
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

WANTED = 0.75  # aim: least F1 of lane lines
EFFECT = 0.05  # deviation from an aim that the study should detect
F1 = "lane F1"


def tables(results: StudyResult[RoadEvaluation]) -> dict[str, str]:
    """Return Markdown by name: findings (a list), lanes, classes, ground, conditions, training."""
    return {
        "findings": format_bullets(_findings(results)),
        "lanes": _lanes(results),
        "classes": _rows(results, "class", lambda found: {row.label: row.iou for row in found.classes}),
        "ground": _rows(
            results,
            "distance",
            lambda found: {f"{row.from_m:g} to {row.to_m:g} m": row.mean_m for row in found.ground},
        ),
        "conditions": _rows(results, "weather, light", lambda found: {row.name: row.f1 for row in found.conditions}),
        "training": format_table(
            ("seed", "pictures", "steps", "lane F1 on validation after each epoch; the network of the best is kept"),
            training_rows(results),
        ),
    }


def _findings(results: StudyResult[RoadEvaluation]) -> list[str]:
    aims = {f"Lane F1 of {WANTED} on {test}": Claim(means[F1], WANTED) for test, means in results.summary.items()}
    return [*describe_aims(aims), *describe_limits(aims.values(), EFFECT)]


def _lanes(results: StudyResult[RoadEvaluation]) -> str:
    rows = []
    for test, means in results.summary.items():
        tested = results.tested(test)
        values = [
            _mean([row.precision for row in tested]),
            _mean([row.recall for row in tested]),
            _mean([row.same_kind for row in tested]),
        ]
        counts = sum(row.pictures for row in tested), sum(row.wanted for row in tested)
        rows.append([test, *counts, means[F1].describe(), *values, means["mIoU"].describe()])
    return format_table(
        ("test", "pictures", "lane lines", "lane F1", "precision", "recall", "kind right", "mIoU"), rows
    )


def _rows(
    results: StudyResult[RoadEvaluation], head: str, values: Callable[[RoadEvaluation], dict[str, float | None]]
) -> str:
    """Return a table with a row per name in `values` and a column per test, of means over seeds."""
    tests = {test: [values(found) for found in results.tested(test)] for test in results.summary}
    names = dict.fromkeys(name for seeds in tests.values() for row in seeds for name in row)
    cells = [
        [name.replace("_", " "), *(_mean([row.get(name) for row in seeds]) for seeds in tests.values())]
        for name in names
    ]
    return format_table((head, *tests), cells)


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.3f}" if known else ""


def _draw(results: StudyResult[RoadEvaluation]) -> bytes:
    """Return a PNG with a panel per test: F1 of lane lines, in total and by condition, and IoU by class."""
    panels = {}
    for test, means in results.summary.items():
        numbers = [found.numbers() for found in results.tested(test)]
        panels[test] = [
            Bar(name.replace("_", " "), means[name].mean, tuple(row[name] for row in numbers))
            for name in numbers[0]
            if name in means and not name.startswith("ground error")
        ]
    return style.png(precisions(panels, label="F1 of lane lines and intersection over union"))


def _is_share(name: str) -> bool:
    return not name.startswith("ground error")


STUDY = Study(ROAD, ROAD.study(), draw=_draw, is_share=_is_share)

EXPERIMENT = make_experiment(STUDY, tables)
