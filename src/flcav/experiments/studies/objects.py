"""The study of the object task: three towns to learn from, other scenes of each to test, tracks besides.

The sweeps are those of recipes/objects.yaml, in every town. Scores are calibrated on the validation frames.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.task_study import Study, StudyResult, recipe_of
from flcav.perception.objects.model import Second
from flcav.perception.objects.results import ObjectsEvaluation
from flcav.perception.objects.task import OBJECTS
from flcav.perception.tracking import evaluate_tracks
from flcav.report import style
from flcav.report.precision import Bar, precisions

RECIPE = recipe_of("objects")
SEQUENCES = {**RECIPE, "spins_per_scene": 30, "every_s": 0.5, "cavs": 1}
TOWNS = ("suburb", "ring", "grid")
CHANGING = {"classes": ["clear", "light_rain", "heavy_rain", "fog"], "turn_s": 4.0}
WEATHERS = "weathers"
TRACKS = "tracks"


def followed(found: ObjectsEvaluation, network: Second, data: Dataset) -> ObjectsEvaluation:
    """Return the evaluation with that of the network's tracks besides."""
    return replace(found, tracks=evaluate_tracks(network, data))


def _numbers(found: ObjectsEvaluation) -> Mapping[str, float]:
    """Return AP in 3D and from above of each class, AOS, headings, the error of calibration, MOTA of tracks."""
    ap = {f"{row.label} AP {row.kind} at {row.iou}": row.ap for row in found.scores}
    headings = {
        f"{row.label} {name}": value
        for row in found.scores
        if (row.kind, row.iou) == ("3d", 0.5)
        for name, value in (("AOS 3d at 0.5", row.aos), ("right headings", row.right_headings))
    }
    errors = {f"{row.label} calibration error": row.ece for row in found.trust}
    tracks = {
        f"{row.label} {name}": value
        for row in (found.tracks.scores if found.tracks else ())
        for name, value in (("MOTA", row.mota), ("AMOTA", row.amota))
    }
    return {name: value for name, value in (ap | headings | errors | tracks).items() if value is not None}


def _draw(results: StudyResult[ObjectsEvaluation]) -> bytes:
    """Return AP at IoU 0.5 in 3D of each test: of the classes, and of cars by distance and occlusion."""
    panels = {}
    for test in results.summary:
        rows: dict[tuple[str, int], list[float]] = {}
        for found in results.tested(test):
            classes = [(row.label, row) for row in found.scores]
            slices = [(f"cars, {row.by} {row.slice}", row) for row in found.slices if row.label == "Car"]
            for name, row in (*classes, *slices):
                if (row.kind, row.iou) == ("3d", 0.5) and row.ap is not None:
                    rows.setdefault((name, row.targets), []).append(row.ap)
        panels[test] = [Bar(name, float(np.mean(ap)), tuple(ap), count) for (name, count), ap in rows.items()]
    return style.png(precisions(panels))


STUDY = Study(
    task=OBJECTS,
    network="small",
    train=tuple({**RECIPE, "town": town} for town in TOWNS),
    validation={**RECIPE, "town": "suburb", "seed": 121, "split": "validation", "scenes": 2},
    tests={
        **{town: {**RECIPE, "town": town, "seed": 431, "split": "test", "scenes": 6} for town in TOWNS},
        WEATHERS: {**RECIPE, "town": "suburb", "seed": 531, "split": "test", "scenes": 4, "weather": CHANGING},
        TRACKS: {**SEQUENCES, "town": "suburb", "seed": 631, "split": "test", "scenes": 3},
    },
    epochs=8,
    patience=8,
    evaluation=ObjectsEvaluation,
    numbers=_numbers,
    draw=_draw,
    extra={TRACKS: followed},
)
