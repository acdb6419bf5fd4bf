"""The study of the object task: three towns to learn from, other scenes of each to test, tracks besides.

The sweeps are those of recipes/objects.yaml, in every town. Scores are calibrated on the validation frames.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.task_study import Result, Study, recipe_of
from flcav.perception.objects.model import Second
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


def followed(network: Second, data: Dataset) -> dict[str, Any]:
    """Return the evaluation of the network's tracks."""
    return {TRACKS: evaluate_tracks(network, data)}


def _numbers(result: Result) -> Mapping[str, float]:
    """Return AP in 3D and from above of each class, AOS, headings, the error of calibration, MOTA of tracks."""
    ap = {
        f"{row['class']} AP {row['kind']} at {row['iou']}": row["ap"]
        for row in result["scores"]
        if row["ap"] is not None
    }
    headings = {
        f"{row['class']} {name}": row[key]
        for row in result["scores"]
        for name, key in (("AOS 3d at 0.5", "aos"), ("right headings", "right_headings"))
        if (row["kind"], row["iou"]) == ("3d", 0.5) and row[key] is not None
    }
    errors = {f"{row['class']} calibration error": row["ece"] for row in result["trust"] if row["ece"] is not None}
    rows = result[TRACKS]["scores"] if TRACKS in result else []
    tracks = {
        f"{row['class']} {name.upper()}": row[name]
        for row in rows
        for name in ("mota", "amota")
        if row[name] is not None
    }
    return ap | headings | errors | tracks


def _draw(results: Mapping[str, Any]) -> bytes:
    """Return AP at IoU 0.5 in 3D of each test: of the classes, and of cars by distance and occlusion."""
    panels = {}
    for test in results["summary"]:
        tested = [seed["tests"][test] for seed in results["seeds"]]
        rows = {}
        for result in tested:
            for row in result["scores"] + [r for r in result["slices"] if r["class"] == "Car"]:
                if (row["kind"], row["iou"]) == ("3d", 0.5) and row["ap"] is not None:
                    name = row["class"] if "slice" not in row else f"cars, {row['by']} {row['slice']}"
                    rows.setdefault((name, row["targets"]), []).append(row["ap"])
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
    numbers=_numbers,
    draw=_draw,
    extra={TRACKS: followed},
)
