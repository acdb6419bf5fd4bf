"""Markdown tables of the road detector, the road average, sensors' ranges, and Fig. 4."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

from flcav.experiments.roadside.average import ARMS, BOTH, GRAPH, KNOBS, Point, Residual, RoadAverageResult
from flcav.experiments.roadside.cameras import CameraResult
from flcav.experiments.roadside.detector import BINS_M, WITHIN_M, RoadDetectorResult
from flcav.experiments.roadside.fig4 import ARMS as PLACED
from flcav.experiments.roadside.fig4 import EDGES_M, Fig4
from flcav.experiments.roadside.labels import EXACT, RoadLabels
from flcav.experiments.roadside.ranges import EDGES_M as SENSOR_EDGES_M
from flcav.experiments.roadside.ranges import SensorRanges
from flcav.storage.markdown import format_table

WHEN = ("as stated", "after the pose graph")


def detector_tables(results: RoadDetectorResult) -> dict[str, str]:
    """Return Markdown by name: towns, distances, labels."""
    towns = [
        [
            f"{each.town}{' (trained there)' if each.seen else ''}",
            each.frames,
            each.cars,
            each.recall.describe(),
            each.detections,
            each.precision.describe(),
        ]
        for each in results.towns
    ]
    header = ("town", "frames", "cars", "recall", f"detections within {WITHIN_M:g} m", "precision")
    near = [(low, high) for low, high in pairwise(BINS_M) if high <= WITHIN_M]
    rows = [
        [
            each.town,
            *(f"{found / cars:.2f} of {cars}" if cars else "none" for cars, found in each.by_distance[: len(near)]),
        ]
        for each in results.towns
    ]
    return {
        "towns": format_table(header, towns),
        "distances": format_table(("recall", *(f"{low} to {high} m" for low, high in near)), rows),
        "labels": _labels(results.labels),
    }


def _labels(labels: RoadLabels) -> str:
    """Return what becomes of the ideal detector's labels with the trained one."""
    parts = {
        "all": labels.ideal,
        "beyond the field of the trained detector": labels.beyond,
        "in its field, not found": labels.missed,
        f"found, at a 3D IoU below {EXACT}": labels.coarse,
        f"found, at a 3D IoU of {EXACT} or more": labels.exact,
        "labels of the trained detector on other objects": labels.other,
        "labels of the trained detector at a bird's-eye IoU below 0.5 with all objects": labels.false,
    }
    sweeps, ideal = max(labels.sweeps, 1), max(labels.ideal, 1)
    rows = [[name, count, f"{count / sweeps:.2f}", f"{count / ideal:.0%}"] for name, count in parts.items()]
    return format_table(("labels of an ideal detector", f"in {labels.sweeps} sweeps", "a sweep", "share"), rows)


def average_tables(results: RoadAverageResult) -> dict[str, str]:
    """Return Markdown by name: joint, knobs, map, residuals."""
    joint = [[arm, f"{results.clean[arm]:.3f}", _describe(results.joint[arm])] for arm in ARMS]
    rows = [
        [knob, f"{point.size:g}", *(_describe(results.knobs[knob][arm][row]) for arm in ARMS)]
        for knob in KNOBS
        for row, point in enumerate(results.knobs[knob][GRAPH])
    ]
    snapped = results.snapped
    context = [
        ["without the map", f"{snapped.heading_deg[0]:.2f}", snapped.reversed_[0], f"{snapped.ap50[0]:.3f}"],
        ["snapped to lanes", f"{snapped.heading_deg[1]:.2f}", snapped.reversed_[1], f"{snapped.ap50[1]:.3f}"],
    ]
    return {
        "joint": format_table(("AP50", "no errors", f"{BOTH}: mean (range over seeds)"), joint),
        "knobs": format_table(("error: AP50, mean (range over seeds)", "size", *ARMS), rows),
        "map": format_table(("labels", "mean heading error [°]", f"reversed of {snapped.matched}", "AP50"), context),
        "residuals": _residuals(results.residuals),
    }


def _describe(point: Point) -> str:
    """Return the mean over seeds, with their range where they differ."""
    low, high = min(point.ap50), max(point.ap50)
    return f"{point.mean:.3f}" + (f" ({low:.3f} to {high:.3f})" if high > low else "")


def _residuals(residuals: Mapping[str, tuple[Residual, Residual]]) -> str:
    rows = [
        [
            name,
            *(f"{each.position_cm:.1f}" for each in pair),
            *(f"{each.heading_deg:.2f}" for each in pair),
            *(f"{each.clock_ms:.0f}" for each in pair),
        ]
        for name, pair in residuals.items()
    ]
    heads = [f"{measure}, {when}" for measure in ("position [cm]", "heading [°]", "clock [ms]") for when in WHEN]
    return format_table(("errors", *heads), rows)


def fig4_tables(results: Fig4) -> dict[str, str]:
    """Return Markdown by name: residuals, range, cameras."""
    rows = [
        [
            each.name,
            f"{each.apart_m:.0f}",
            f"{each.before.position_cm:.0f} cm, {each.before.rotation_deg:.2f}°",
            f"{each.after.position_cm:.2f} cm, {each.after.rotation_deg:.3f}°",
        ]
        for each in results.suites
    ]
    near = list(pairwise(EDGES_M))
    found = [
        [
            arm,
            *(f"{f / c:.2f}" if c else "" for f, c in zip(results.found[arm], results.cars)),
            f"{results.range_m[arm]:.0f}",
        ]
        for arm in PLACED
    ]
    header = ("share of cars found", *(f"{low}–{high} m" for low, high in near), "range [m]")
    return {
        "residuals": format_table(("suite", "from the first [m]", "off as calibrated", "off as registered"), rows),
        "range": format_table(header, [["cars", *results.cars, ""], *found]),
        "cameras": _tabulate_cameras(results.cameras),
    }


def _tabulate_cameras(cameras: Sequence[CameraResult]) -> str:
    """Return a row for each camera and choice of its extrinsics, as Markdown."""
    header = (
        "camera",
        "extrinsics",
        "off",
        "squared error [sd²]",
        "cars",
        "with a box",
        "rightly associated",
        "pairs",
        "of one car",
        "cars alone",
        "boxes alone",
        "residual [px]",
    )
    rows = [
        [
            each.name,
            name,
            f"{own.off.position_cm:.0f} cm, {own.off.rotation_deg:.2f}°",
            "" if own.squared_error is None else f"{own.squared_error:.1f}",
            each.cars,
            each.pictured,
            f"{own.found} ({own.found / each.cars:.2f})" if each.cars else "",
            own.pairs,
            f"{own.right} ({own.right / own.pairs:.2f})" if own.pairs else "",
            own.lone_cars,
            own.lone_boxes,
            "" if own.residual_px is None else f"{own.residual_px:.1f}",
        ]
        for each in cameras
        for name, own in each.by_extrinsics.items()
    ]
    return format_table(header, rows)


def range_tables(results: SensorRanges) -> dict[str, str]:
    """Return Markdown by name: ranges."""
    rows = [
        [
            f"`{each.name}`",
            each.channels,
            *(f"{found / cars:.2f}" if cars else "" for found, cars in zip(each.found, results.cars, strict=True)),
            f"{each.range_m:g}" if each.range_m else "none",
            f"{each.cost:g}",
        ]
        for each in results.models
    ]
    header = (
        "share of cars found",
        "channels",
        *(f"{a}–{b} m" for a, b in pairwise(SENSOR_EDGES_M)),
        "range [m]",
        "cost",
    )
    return {"ranges": format_table(header, [["cars", "", *results.cars, "", ""], *rows])}
