"""Markdown tables of the sim-to-real experiment."""

from collections.abc import Mapping, Sequence

import numpy as np

from flcav.experiments.sim_to_real.clouds import CloudNumbers, SeenCar
from flcav.experiments.sim_to_real.run import LabelledCar, RealScore, SimToReal
from flcav.storage.markdown import format_table


def tables(results: SimToReal) -> dict[str, str]:
    """Return Markdown by name: detections, cars, clouds."""
    clouds = results.clouds
    return {
        "detections": format_table(
            ("class", "overlap (IoU)", "labelled", "true positives", "false positives", "AP R40"),
            [
                (row.label, f"{row.kind} at {row.iou}", row.targets, *_found(row))
                for row in results.scores
                if row.targets
            ],
        ),
        "cars": format_table(
            ("frame", "distance of the car [m]", "detected at IoU"),
            [(story.frame, *_car(car)) for story in results.frames for car in story.cars],
        ),
        "clouds": format_table(("", *clouds), _clouds(clouds)),
    }


def _found(row: RealScore) -> tuple[int, int, str]:
    return row.found, row.false_positives, "" if row.ap is None else f"{row.ap:.3f}"


def _car(car: LabelledCar) -> tuple[str, str]:
    return f"{car.distance_m:.1f}", ", ".join(map(str, car.found_at)) or "no"


def _clouds(clouds: Mapping[str, CloudNumbers]) -> list[list[str]]:
    columns = list(clouds.values())
    rows = [["returns per frame", *(f"{c.returns:.0f}" for c in columns)]]
    for name in sorted(columns[0].returns_per_range, key=lambda limits: float(limits.split("-")[0])):
        rows.append([f"of them at {name}", *(f"{c.returns_per_range[name]:.0f}" for c in columns)])
    for place, share in enumerate((5, 25, 50, 75, 95)):
        rows.append([f"intensity, {share}th percentile", *(f"{c.intensity_quantiles[place]:.2f}" for c in columns)])
    rows.append(["returns without intensity", *(f"{c.without_intensity:.0%}" for c in columns)])
    for ahead_m in (street.ahead_m for street in columns[0].ground):
        own = [next((street for street in c.ground if street.ahead_m == ahead_m), None) for c in columns]
        for what, values in (
            ("height", [street and street.height_m for street in own]),
            ("interquartile range of height", [street and street.spread_m for street in own]),
            ("intensity", [street and street.intensity for street in own]),
        ):
            cells = ["" if value is None else f"{value:.2f}" for value in values]
            rows.append([f"street {ahead_m} m ahead, {what}", *cells])
    rows.append(["cars: median length, width, height [m]", *(_sizes(c.cars) for c in columns)])
    return rows


def _sizes(cars: Sequence[SeenCar]) -> str:
    if not cars:
        return ""
    sides = np.median([(car.length_m, car.width_m, car.height_m) for car in cars], axis=0)
    return ", ".join(f"{side:.2f}" for side in sides)
