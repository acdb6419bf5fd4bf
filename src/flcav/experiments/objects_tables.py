"""The tables on the page of the object task's study."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.experiments.task_study import training_rows
from flcav.markdown import bullets, table
from flcav.verdicts import aim_sentence

WANTED = {  # of cars on other scenes of the towns that were learned from
    "Car AP 3d at 0.5": (0.85, "Car AP3D@0.5 of 0.85"),
    "Car right headings": (0.9, "90 % of the cars found at 3D IoU 0.5 within 90 degrees of their heading"),
}
HEADINGS = {"AOS3D at 0.5": "aos", "right headings": "right_headings"}  # of those found in 3D at IoU 0.5
MEASURES = (("3d", 0.5), ("3d", 0.7), ("bev", 0.5), ("bev", 0.7))


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the page's tables by name, from what `run_study` returned."""
    heads = [f"{kind} at {overlap}" for kind, overlap in MEASURES]
    return {
        "findings": bullets(_findings(results)),
        "classes": table(("test", "class", "to find", *heads, *HEADINGS, "calibration error"), _classes(results)),
        "slices": table(("test", "cars", "to find", *heads), _slices(results)),
        "training": table(
            ("seed", "sweeps", "steps", "validation, mean AP3D@0.5 of the classes, after each epoch; the best is kept"),
            training_rows(results),
        ),
        "tracks": table(("class", "MOTA", "AMOTA", "id switches", "velocity off by [m/s]"), _tracks(results)),
    }


def _findings(results: Mapping[str, Any]) -> list[str]:
    seeds, said = len(results["seeds"]), []
    for test in dict.fromkeys(recipe["town"] for recipe in results["recipes"]["train"]):
        for name, (wanted, claim) in WANTED.items():
            said.append(aim_sentence(f"{claim} on {test}", wanted, results["summary"][test][name], seeds) + ".")
    return said


def _classes(results: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for test in results["summary"]:
        tested = [seed["tests"][test] for seed in results["seeds"]]
        for trust in tested[0]["trust"]:
            name = trust["class"]
            of_class = [[row for row in one["scores"] if row["class"] == name] for one in tested]
            errors = [row["ece"] for one in tested for row in one["trust"] if row["class"] == name]
            half = [row for rows in of_class for row in rows if (row["kind"], row["iou"]) == MEASURES[0]]
            headings = [_mean([row[key] for row in half]) for key in HEADINGS.values()]
            rows.append([test, name, str(of_class[0][0]["targets"]), *_measures(of_class), *headings, _mean(errors)])
    return rows


def _slices(results: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for test in results["summary"]:
        tested = [seed["tests"][test]["slices"] for seed in results["seeds"]]
        names = dict.fromkeys((row["by"], row["slice"]) for row in tested[0] if row["class"] == "Car")
        for by, name in names:
            own = [[r for r in one if (r["by"], r["slice"], r["class"]) == (by, name, "Car")] for one in tested]
            rows.append([test, f"{by} {name}", str(own[0][0]["targets"]), *_measures(own)])
    return rows


def _tracks(results: Mapping[str, Any]) -> list[list[str]]:
    tested = [seed["tests"]["tracks"]["tracks"]["scores"] for seed in results["seeds"]]
    rows = []
    for number, row in enumerate(tested[0]):
        seeds = [one[number] for one in tested]
        columns = (
            _mean([seed[key] for seed in seeds]) for key in ("mota", "amota", "id_switches", "velocity_error_mps")
        )
        rows.append([row["class"], *columns])
    return rows


def _measures(seeds: list[list[Mapping[str, Any]]]) -> list[str]:
    """Return the mean AP over seeds of each measure; seeds: the rows of each."""
    return [
        _mean([row["ap"] for rows in seeds for row in rows if (row["kind"], row["iou"]) == measure])
        for measure in MEASURES
    ]


def _mean(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f}" if known else ""
