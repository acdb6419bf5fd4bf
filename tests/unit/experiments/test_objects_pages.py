"""The pages' tables, from small results made by hand."""

import numpy as np

from flcav.experiments.study import SeedResult, StudyRecordings, StudyResult
from flcav.geometry import Boxes
from flcav.perception.images import CameraView
from flcav.perception.objects.evaluate import ObjectsEvaluation
from flcav.perception.weights import Card
from flcav.report.pictures.clouds import real_frame
from flcav.reproductions.sim_to_real import run as sim_to_real_tables
from flcav.reproductions.sim_to_real.clouds import CloudNumbers, SeenCar, Street
from flcav.reproductions.sim_to_real.run import FrameResult, LabelledCar, RealScore, SimToReal, draw_clouds
from flcav.reproductions.task_objects import run as objects_tables
from flcav.reproductions.task_objects.run import STUDY
from flcav.runs.provenance import provenance
from flcav.statistics.seeds import mean_over_seeds


def result(ap):
    measures = [(kind, iou) for kind in ("3d", "bev") for iou in (0.5, 0.7)]
    row = {
        "class": "Car",
        "low": ap,
        "high": ap,
        "targets": 12,
        "hidden": 0,
        "ap": ap,
        "aos": ap - 0.1,
        "right_headings": 0.95,
    }
    sliced = {"class": "Car", "by": "distance", "slice": "0-20 m", "targets": 7, "ap": ap}
    return {
        "frames": 3,
        "scenes": 1,
        "scores": [row | {"kind": kind, "iou": iou} for kind, iou in measures],
        "slices": [sliced | {"kind": kind, "iou": iou} for kind, iou in measures],
        "trust": [{"class": "Car", "detections": 9, "ece": 0.04, "variance_ratio": 1.1}],
    }


def tracked(ap):
    row = {"class": "Car", "mota": 0.7, "amota": 0.6, "id_switches": 2, "velocity_error_mps": 0.5}
    row |= {"objects": 9, "motp_m": 0.2, "misses": 1, "false_positives": 1}
    return result(ap) | {"tracks": {"sequences": 1, "frames": 3, "scores": [row]}}


def study(aps):
    card = {"task": "objects", "network": "small", "parameters": 9, "seed": 1, "samples": 40, "data": [], "metrics": {}}
    card["training"] = {"steps": 60, "loss": 1.0, "scores": [0.25, 0.5]}
    seeds = tuple(
        SeedResult(
            n,
            Card.model_validate(card),
            {
                "suburb": ObjectsEvaluation.from_json(result(ap), "suburb"),
                "tracks": ObjectsEvaluation.from_json(tracked(ap), "tracks"),
            },
            {"suburb": n, "tracks": n},
        )
        for n, ap in enumerate(aps)
    )
    summary = {}
    for test in ("suburb", "tracks"):
        rows = [seed.tests[test].numbers() for seed in seeds]
        summary[test] = {name: mean_over_seeds([row[name] for row in rows]) for name in rows[0]}
    recipes = StudyRecordings(({"town": "suburb"},), {}, {})
    return StudyResult("objects", "small", "full", 8, 8, recipes, seeds, summary, provenance())


def test_what_is_reached_is_said_with_its_interval():
    reached = objects_tables.tables(study((0.9, 0.91, 0.905)))["findings"]
    assert "**reached**, 0.905 (0.893 to 0.917) over 3 seeds of standard deviation 0.005; p" in reached
    assert "**undecided**" in objects_tables.tables(study((0.8, 0.9)))["findings"]
    assert "**undecided**, 0.500 of one seed" in objects_tables.tables(study((0.5,)))["findings"]


def test_tables_hold_classes_slices_and_tracks():
    tables = objects_tables.tables(study((0.8, 0.9)))
    assert "| suburb | Car | 12 | 0.850 | 0.850 | 0.850 | 0.850 | 0.750 | 0.950 | 0.040 |" in tables["classes"]
    assert "| suburb | distance 0-20 m | 7 |" in tables["slices"]
    assert "| Car | 0.700 | 0.600 | 2.000 | 0.500 |" in tables["tracks"]
    assert "| 1 | 40 | 60 | 0.25, 0.50 |" in tables["training"]
    assert "tracks" not in tables["findings"]


def test_a_study_is_drawn():
    assert STUDY.draw(study((0.8, 0.9))).startswith(b"\x89PNG")


def cloud():
    return CloudNumbers(
        frames=1,
        returns=100.0,
        returns_per_range={"0-5 m": 40.0},
        intensity_quantiles=(0, 0.1, 0.2, 0.3, 0.4),
        without_intensity=0.25,
        ground=(Street("5-8", height_m=-1.7, spread_m=0.1, intensity=0.3),),
        cars=(SeenCar(5.0, 9, length_m=4.0, width_m=1.7, height_m=1.5, without_intensity=0.0),),
    )


def test_clouds_and_real_cars_stand_beside_each_other():
    score = RealScore("Car", "3d", 0.5, targets=1, found=1, false_positives=0, ap=1.0)
    story = FrameResult("000008", (), (LabelledCar(5.0, (0.5,)),))
    tables = sim_to_real_tables.tables(
        SimToReal({"KITTI": cloud(), "simulated": cloud()}, (score,), (story,), provenance())
    )
    assert "| 000008 | 5.0 | 0.5 |" in tables["cars"]
    assert "| Car | 3d at 0.5 | 1 | 1 | 0 | 1.000 |" in tables["detections"]
    assert "| returns without intensity | 25% | 25% |" in tables["clouds"]


def test_clouds_and_frames_are_drawn():
    assert draw_clouds(SimToReal({"KITTI": cloud(), "simulated": cloud()}, (), (), provenance())).startswith(b"\x89PNG")
    cars = Boxes.from_array([[12, 0, -1, 4, 1.7, 1.5, 0.1]], "Car")
    camera_from_lidar = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)
    intrinsics = np.array([[700, 0, 600], [0, 700, 180], [0, 0, 1]], dtype=float)
    view = CameraView(np.zeros((375, 1242, 3), np.uint8), camera_from_lidar, intrinsics, np.zeros(5))
    figure = real_frame("000008", np.ones((9, 4), np.float32), view, cars, np.zeros(1, bool), cars)
    assert "0 of 1 cars found" in figure.axes[0].get_title(loc="left")
