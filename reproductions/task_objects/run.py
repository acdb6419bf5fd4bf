"""Study of the object task: AP by class, distance and occlusion, headings, calibration and tracks."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.study import Study, StudyResult, describe_limits, list_counts, make_experiment, training_rows
from flcav.perception.objects.evaluate import BreakdownRow, ObjectsEvaluation, Score
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS, TRACKS, streets_study
from flcav.perception.tracking import evaluate_tracks
from flcav.report import style
from flcav.report.charts.studies import Bar, precision_table
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

WANTED = {  # aims for cars on other scenes of the training towns, by number: least value, claim
    "Car AP 3d at 0.5": (0.85, "Car AP3D@0.5 of 0.85"),
    "Car right headings": (0.9, "90 % of the cars found at 3D IoU 0.5 within 90 degrees of their heading"),
}
EFFECT = 0.05  # deviation from an aim that the study should detect
HEADINGS = ("AOS3D at 0.5", "right headings")  # of objects found at 3D IoU 0.5
MEASURES = (("3d", 0.5), ("3d", 0.7), ("bev", 0.5), ("bev", 0.7))


def tables(results: StudyResult[ObjectsEvaluation]) -> dict[str, str]:
    """Return Markdown by name: findings (a list), classes, slices, training, and tracks where these were tested."""
    heads = [f"{kind} at {overlap}" for kind, overlap in MEASURES]
    tracked = format_table(("class", "MOTA", "AMOTA", "id switches", "velocity error [m/s]"), _tracks(results))
    return {
        "findings": format_bullets(_findings(results)),
        "classes": format_table(
            ("test", "class", "targets", *heads, *HEADINGS, "calibration error"), _classes(results)
        ),
        "slices": format_table(("test", "subset of cars", "targets", *heads), _slices(results)),
        "training": format_table(
            ("seed", "sweeps", "steps", "validation, mean AP3D@0.5 of the classes, after each epoch; the best is kept"),
            training_rows(results),
        ),
        **({"tracks": tracked} if TRACKS in results.summary else {}),
    }


def _findings(results: StudyResult[ObjectsEvaluation]) -> list[str]:
    towns = dict.fromkeys(str(recipe["town"]) for recipe in results.recipes.train)
    aims = {
        f"{claim} on {town}": Claim(results.summary[town][name], wanted)
        for town in towns
        for name, (wanted, claim) in WANTED.items()
    }
    return [*describe_aims(aims), *describe_limits(aims.values(), EFFECT)]


def _classes(results: StudyResult[ObjectsEvaluation]) -> list[list[str]]:
    rows = []
    for test in results.summary:
        tested = results.tested(test)
        for name in (trust.label for trust in tested[0].trust):
            of_class = [[row for row in one.scores if row.label == name] for one in tested]
            errors = [row.ece for one in tested for row in one.trust if row.label == name]
            half = [row for rows in of_class for row in rows if (row.kind, row.iou) == MEASURES[0]]
            headings = [_mean(row.aos for row in half), _mean(row.right_headings for row in half)]
            targets = list_counts([rows[0].targets for rows in of_class])
            rows.append([test, name, targets, *_measures(of_class), *headings, _mean(errors)])
    return rows


def _slices(results: StudyResult[ObjectsEvaluation]) -> list[list[str]]:
    rows = []
    for test in results.summary:
        tested = [[row for row in one.slices if row.label == "Car"] for one in results.tested(test)]
        for by, name in dict.fromkeys((row.by, row.slice) for one in tested for row in one):
            by_seed = [[row for row in one if (row.by, row.slice) == (by, name)] for one in tested]
            targets = list_counts([one[0].targets if one else 0 for one in by_seed])
            rows.append([test, f"{by} {name}", targets, *_measures(by_seed)])
    return rows


def _tracks(results: StudyResult[ObjectsEvaluation]) -> list[list[str]]:
    rows = []
    tested = results.tested(TRACKS) if TRACKS in results.summary else []
    for seeds in zip(*(found.tracks.scores for found in tested if found.tracks)):
        numbers = zip(*((row.mota, row.amota, row.id_switches, row.velocity_error_mps) for row in seeds))
        rows.append([seeds[0].label, *map(_mean, numbers)])
    return rows


def _measures(seeds: Sequence[Sequence[Score | BreakdownRow]]) -> list[str]:
    """Return the mean AP over seeds for each of `MEASURES`; `seeds`: rows of each seed."""
    return [_mean(row.ap for rows in seeds for row in rows if (row.kind, row.iou) == measure) for measure in MEASURES]


def _mean(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f}" if known else ""


def add_tracks(found: ObjectsEvaluation, network: Second, data: Dataset) -> ObjectsEvaluation:
    """Return the evaluation with that of the network's tracks (MOTA, AMOTA)."""
    return replace(found, tracks=evaluate_tracks(network, data))


def _draw(results: StudyResult[ObjectsEvaluation]) -> bytes:
    """Return a PNG of AP at 3D IoU 0.5 for each test: by class, and of cars by distance and occlusion."""
    panels = {}
    for test in results.summary:
        rows: dict[str, list[Score | BreakdownRow]] = {}
        for found in results.tested(test):
            classes = [(row.label, row) for row in found.scores]
            slices = [(f"cars, {row.by} {row.slice}", row) for row in found.slices if row.label == "Car"]
            for name, row in (*classes, *slices):
                if (row.kind, row.iou) == ("3d", 0.5) and row.ap is not None:
                    rows.setdefault(name, []).append(row)
        panels[test] = [_bar(name, scores) for name, scores in rows.items()]
    panels = {test: [replace(bar, name=bar.name.replace("_", " ")) for bar in bars] for test, bars in panels.items()}
    return style.png(
        precision_table(panels, "AP in 3D at IoU 0.5: mean over seeds ± half their range; number of targets")
    )


def _is_share(name: str) -> bool:
    return not name.endswith(" MOTA")  # which may be negative


def _bar(name: str, rows: Sequence[Score | BreakdownRow]) -> Bar:
    """Return the bar of a mean over seeds, with the mean number of targets; `rows`: of each seed."""
    ap = [row.ap for row in rows if row.ap is not None]
    return Bar(name, float(np.mean(ap)), tuple(ap), round(np.mean([row.targets for row in rows])))


STUDY = Study(OBJECTS, OBJECTS.study(), draw=_draw, extra={TRACKS: add_tracks}, is_share=_is_share)
STREETS = Study(OBJECTS, streets_study(), draw=_draw, is_share=_is_share)

EXPERIMENT = make_experiment(STUDY, tables)
