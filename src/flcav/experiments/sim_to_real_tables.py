"""The tables on the page about simulation and reality."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.markdown import table


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the page's tables by name, from what `run_sim_to_real` returned."""
    clouds = results["clouds"]
    return {
        "detections": table(
            ("class", "overlap", "labelled", "found", "false", "AP R40"),
            [
                (row["class"], f"{row['kind']} at {row['iou']}", row["targets"], *_found(row))
                for row in results["scores"]
                if row["targets"]
            ],
        ),
        "cars": table(
            ("frame", "car at [m]", "found at IoU"),
            [(story["frame"], *_car(car)) for story in results["frames"] for car in story["cars"]],
        ),
        "clouds": table(("", *clouds), _clouds(clouds)),
    }


def _found(row: Mapping[str, Any]) -> tuple[int, int, str]:
    return row["found"], row["false_positives"], f"{row['ap']:.3f}"


def _car(car: Mapping[str, Any]) -> tuple[str, str]:
    return f"{car['distance_m']:.1f}", ", ".join(map(str, car["found_at"])) or "no"


def _clouds(clouds: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    columns = list(clouds.values())
    rows = [["returns per frame", *(f"{c['returns']:.0f}" for c in columns)]]
    for name in sorted(columns[0]["returns_per_range"], key=lambda limits: float(limits.split("-")[0])):
        rows.append([f"of them at {name}", *(f"{c['returns_per_range'][name]:.0f}" for c in columns)])
    for place, share in enumerate((5, 25, 50, 75, 95)):
        rows.append([f"intensity, {share} % are below", *(f"{c['intensity_quantiles'][place]:.2f}" for c in columns)])
    rows.append(["returns without intensity", *(f"{c['without_intensity']:.0%}" for c in columns)])
    for street in columns[0]["ground"]:
        for key, what in (("height_m", "height"), ("spread_m", "spread of height"), ("intensity", "intensity")):
            values = [_street(c, street["ahead_m"], key) for c in columns]
            rows.append([f"street {street['ahead_m']} m ahead, {what}", *values])
    rows.append(["cars: median length, width, height [m]", *(_sizes(c["cars"]) for c in columns)])
    return rows


def _street(cloud: Mapping[str, Any], ahead_m: str, key: str) -> str:
    return next((f"{row[key]:.2f}" for row in cloud["ground"] if row["ahead_m"] == ahead_m), "")


def _sizes(cars: list[Mapping[str, float]]) -> str:
    sides = [np.median([car[side] for car in cars]) for side in ("length_m", "width_m", "height_m")]
    return ", ".join(f"{side:.2f}" for side in sides) if cars else ""
