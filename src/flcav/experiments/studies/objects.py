"""The study of the object task: its tracks are followed besides, and AP drawn by class, distance and occlusion."""

from dataclasses import replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.task_study import Study, StudyResult
from flcav.perception.objects.model import Second
from flcav.perception.objects.results import ObjectsEvaluation
from flcav.perception.objects.study import TRACKS
from flcav.perception.objects.task import OBJECTS
from flcav.perception.tracking import evaluate_tracks
from flcav.report import style
from flcav.report.precision import Bar, precisions


def followed(found: ObjectsEvaluation, network: Second, data: Dataset) -> ObjectsEvaluation:
    """Return the evaluation with that of the network's tracks besides."""
    return replace(found, tracks=evaluate_tracks(network, data))


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


STUDY = Study(OBJECTS, OBJECTS.study(), draw=_draw, extra={TRACKS: followed})
