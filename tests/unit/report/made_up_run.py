"""Made-up inputs with the shape of a real run's."""

from typing import Any

import numpy as np

from flcav.geometry import Boxes
from flcav.report.maps import ErrorMap, poles_of
from flcav.report.sweeps import Detections, Sweep
from flcav.world.town import load_town


def stage(name: str, town: str, ap50: float, **more: float) -> dict[str, Any]:
    return {
        "name": name,
        "town": town,
        "ap50": ap50,
        "ap50_low": ap50 - 0.041,
        "ap50_high": ap50 + 0.038,
        "ap70": ap50 - 0.19,
        "aos50": ap50 - 0.02,
        "right_headings": 0.96,
        "samples": 0,
        "rounds": 0,
        "wireless_mb": 0.0,
        "wireline_mb": 0.0,
    } | more


def results() -> dict[str, Any]:
    """Return the results of an invented run; findings are left to `flcav.experiments.findings`."""
    stages = {
        town: [
            stage("pretrained", town, first, samples=320, wireless_mb=118.4, wireline_mb=118.4),
            stage("edge FL", town, second, rounds=6, wireless_mb=64.2),
            stage("edge + cloud FL", town, third, rounds=3, wireless_mb=32.1, wireline_mb=9.2),
        ]
        for town, first, second, third in (("grid", 0.412, 0.503, 0.511), ("ring", 0.381, 0.447, 0.468))
    }
    return {
        "seed": 7,
        "elapsed_s": 538.2,
        "test_frames": 96,
        "test_scenes": 8,
        "stages": stages["grid"],
        "ring": stages["ring"],
        "placement": {
            "chosen": 2,
            "densest": 8,
            "errors": 61,
            "covered": 19,
            "range_m": 40.0,
            "ap50_chosen": 0.503,
            "ap50_densest": 0.471,
            "difference": {"mean": 0.032, "low": 0.004, "high": 0.061},
            "coverage": [
                {"pole": pole, "covered": covered, "actors": actors}
                for pole, (covered, actors) in enumerate(
                    zip((12, 19, 9, 7, 15, 11, 4, 6, 3), (5.1, 6.2, 4.4, 3.8, 7.0, 5.5, 6.1, 12.4, 2.2)), start=1
                )
            ],
        },
        "differences": {
            "edge_minus_pretrained": {"mean": 0.091, "low": 0.055, "high": 0.127},
            "cloud_minus_edge": {"mean": 0.008, "low": -0.012, "high": 0.027},
        },
        "allocation": {
            "samples": 320,
            "edge_rounds": 6,
            "cloud_rounds": 3,
            "predicted_error": 0.47,
            "vehicles": [4, 3],
        },
        "ledger": {
            "wireless": {"budget_mb": 230.0, "used_mb": 214.7, "planned_mb": 216.0},
            "wireline": {"budget_mb": 135.0, "used_mb": 127.6, "planned_mb": 128.1},
        },
        "ledger_by_stage": [
            {"stage": stage, "link": link, "mb": mb}
            for stage, link, mb in (
                ("pretraining", "wireless", 118.4),
                ("pretraining", "wireline", 118.4),
                ("edge FL", "wireless", 64.2),
                ("edge FL", "wireline", 0.0),
                ("cloud FL", "wireless", 32.1),
                ("cloud FL", "wireline", 9.2),
            )
        ],
        "rounds": rounds(),
        "versions": {"flcav": "0.1.0", "numpy": "2.2.6", "torch": "2.9.0"},
    }


def rounds() -> list[dict[str, Any]]:
    rng = np.random.default_rng(3)
    rows = [
        {"stage": "pretraining", "round": n, "town": "suburb", "ap50": 0.62 * (1 - np.exp(-n / 3))} for n in range(1, 9)
    ]
    for town, start, middle, end in (("grid", 0.41, 0.50, 0.51), ("ring", 0.38, 0.45, 0.47)):
        rows.append({"stage": "pretraining", "round": 8, "town": town, "ap50": start})
        for n in range(1, 7):
            ap50 = middle - (middle - start) * np.exp(-n / 2) + rng.normal(0, 0.006)
            rows.append({"stage": "edge FL", "round": n, "town": town, "ap50": ap50})
        for n in range(1, 4):
            ap50 = end - (end - middle) * np.exp(-n) + rng.normal(0, 0.004)
            rows.append({"stage": "cloud FL", "round": n, "town": town, "ap50": ap50})
    return [{**row, "ap50": float(row["ap50"])} for row in rows]


def error_map(town: str = "grid", errors: int = 61) -> ErrorMap:
    place = load_town(town)
    rng = np.random.default_rng(1)
    road = np.concatenate(place.roads)
    xy = road[rng.integers(len(road), size=errors)] + rng.normal(0, 4, (errors, 2))
    kind = np.where(rng.random(errors) < 0.7, "miss", "false_positive")
    xyz = np.c_[xy, np.full(errors, 0.8)]
    return ErrorMap(place, xyz, kind, poles_of(place), chosen=("2",), densest="8", range_m=40.0)


def sweep() -> Sweep:
    rng = np.random.default_rng(2)
    rows = [[12, 3, -1, 4.5, 1.8, 1.5, 0.0], [24, -3, -1, 4.5, 1.8, 1.5, 3.1], [33, 4, -1, 5.4, 2, 2.3, 0.1],
            [40, -12, -1, 4.2, 1.8, 1.5, 1.5], [19, 12, -1, 4.6, 1.8, 1.5, 1.6]]  # fmt: skip
    targets = Boxes.from_array(rows, "Car")
    false = np.array([[28.0, -16.0, -1, 4.4, 1.8, 1.5, 0.4]])
    near = targets.array() + rng.normal(0, 0.15, (5, 7))
    angle = rng.uniform(-np.pi / 2, np.pi / 2, 9000)
    reach = np.repeat(np.geomspace(5, 45, 18), 500) * (1 + 0.01 * rng.normal(size=9000))
    ground = np.c_[reach * np.cos(angle), reach * np.sin(angle), np.full(9000, -1.7), np.zeros(9000)]
    on_boxes = [
        np.c_[row[0] + rng.uniform(-2, 0, 80), row[1] + rng.uniform(-0.9, 0.9, 80), np.zeros((80, 2))] for row in rows
    ]
    before = Boxes.from_array(np.r_[near[:2], false], "Car", [0.9, 0.8, 0.4])
    after = Boxes.from_array(near[[0, 1, 2, 4]], "Car", [0.9, 0.9, 0.6, 0.5])
    return Sweep(
        points=np.concatenate((ground, *on_boxes)).astype(np.float32),
        ground_m=-1.7,
        targets=targets,
        before=Detections("Pretrained", before, np.array([True, True, False]), np.array([1, 1, 0, 0, 0], dtype=bool)),
        after=Detections("Edge + cloud FL", after, np.ones(4, dtype=bool), np.array([1, 1, 1, 0, 1], dtype=bool)),
    )
