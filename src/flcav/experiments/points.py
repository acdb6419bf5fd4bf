"""The points that a run adds to history: what it reached after so much of each stage, as `flcav fit` reads them."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flcav.experiments.protocol import TASK
from flcav.files import atomic_path

HISTORY_FILE = "history.csv"
POINT: tuple[str, ...] = ("task", "samples", "edge_rounds", "cloud_rounds", "accuracy", "weight", "run")


def points_of(values: Mapping[str, Any], run: str, town: str = "grid") -> list[dict[str, Any]]:
    """Return the points of a finished run's tests in `town`, weighted by the frames they are measured on.

    `values` are those of its steps; a stage or its rounds that were not tested have none.
    """
    planned = values["plan"]["tasks"][0]
    points: list[dict[str, Any]] = []
    spent: tuple[int, ...] = ()
    for arm, resource in (
        ("pretrain", planned["samples"]),
        (f"{town}-edge-chosen", planned["edge_rounds"]),
        ("cloud", planned["cloud_rounds"]),
    ):
        test = values.get(f"test-{arm}-{town}")
        rows = [row for row in values.get(f"rounds-{arm}-{town}", []) if test is None or row["round"] < resource]
        for row in [*rows, *([{"round": resource, **test}] if test is not None else [])]:
            counts = (*spent, row["round"], 0, 0)[:3]
            point = (TASK, *counts, f"{row['ap50']:.4f}", row["frames"], run)
            points.append(dict(zip(POINT, point, strict=True)))
        spent = (*spent, resource)
    return points


def append_points(path: Path, points: Sequence[Mapping[str, Any]]) -> None:
    """Add to the history at `path` the points that it does not hold yet."""
    held: list[dict[str, str]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            held = list(csv.DictReader(file))
    told = [{name: str(value) for name, value in point.items()} for point in points]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, POINT, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*held, *(point for point in told if point not in held)])
