"""Clouds in numbers, and detections in a real frame, against what can be counted by hand."""

from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.formats.kitti.files import KittiCalibration, KittiFrame, Objects
from flcav.dataset.recording.recorder import record
from flcav.geometry import Boxes
from flcav.perception.kitti_benchmark import select_shown, truth_of
from flcav.perception.objects.config import small_config
from flcav.perception.objects.model import second
from flcav.reproductions.sim_to_real import run as sim_to_real
from flcav.reproductions.sim_to_real.clouds import summarise_clouds
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

LIDAR_TO_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)
PROJECTION = np.array([[700, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]], dtype=float)


def boxes(*places, label="Car", score=None):
    rows = np.array([(x, y, -1.0, 4.0, 1.6, 1.5, 0.0) for x, y in places]).reshape(-1, 7)
    return Boxes.from_array(rows, label, score)


def frame(objects: Boxes) -> KittiFrame:
    count = len(objects)
    labelled = Objects(objects, np.zeros(count), np.zeros(count, dtype=np.int64), np.zeros(count), np.zeros((count, 4)))
    calibration = KittiCalibration(LIDAR_TO_CAMERA, PROJECTION)
    image = np.zeros((375, 1242, 3), np.uint8)
    return KittiFrame("000001", np.ones((5, 4), np.float32), calibration, labelled, image, (375, 1242))


def test_numbers_of_a_cloud_are_counts():
    street = [(x, 0.0, -1.7, 0.3) for x in (6.2, 6.5, 7, 7.5)]
    on_car = [(20.0, 0.0, -1.0, i) for i in (0.0, 0.0, 0.2)]
    behind = [(-10.0, 0.0, -1.7, 0.9)]
    said = summarise_clouds([(np.array(street + on_car + behind, np.float32), boxes((20, 0), (40, 0)))])
    assert said.returns == 7
    assert said.returns_per_range["5-10 m"] == 4
    assert said.returns_per_range["20-25 m"] == 3
    assert said.without_intensity == pytest.approx(2 / 7)
    assert said.ground[0].height_m == pytest.approx(-1.7)
    assert said.ground[0].intensity == pytest.approx(0.3)
    (car,) = said.cars
    assert (car.returns, car.length_m, car.distance_m) == (3, 4.0, 20.0)
    assert car.without_intensity == pytest.approx(2 / 3)


def test_what_the_image_does_not_show_does_not_count():
    everything = boxes((20, 0), (-20, 0), (10, 12))
    np.testing.assert_array_equal(select_shown(everything, frame(boxes())).center[:, 0], [20])


def test_a_detection_outside_the_image_counts_where_it_overlaps_a_labelled_object():
    labelled = frame(boxes((10, 12.5)))
    np.testing.assert_array_equal(select_shown(boxes((20, 0), (10, 12), (10, -12)), labelled).center[:, 1], [0, 12])
    nothing = Boxes.from_array(np.zeros((0, 7)), "Car")
    assert len(select_shown(nothing, labelled)) == 0


def test_similar_classes_are_neutral_for_the_one_that_they_resemble():
    places = boxes((20, 0), (30, 0), (40, 0))
    objects = Boxes.from_array(places.array(), np.array(["Car", "Truck", "Person_sitting"]))
    truth = truth_of(frame(objects))
    assert truth.targets.center[:, 0].tolist() == [20]
    assert list(zip(truth.neutral.label.tolist(), truth.neutral.center[:, 0].tolist(), strict=True)) == [
        ("Car", 30),
        ("Pedestrian", 40),
    ]


def test_real_frames_are_judged_as_kitti_does() -> None:
    found = boxes((20, 0), (40, 0), (30, 5), (60, 0), score=np.array([0.9, 0.8, 0.7, 0.6]))
    van = Boxes.from_array(np.array([(30, 5, -1.0, 5, 2, 2, 0.0)]), "Van")
    cars = boxes((20, 0), (40.9, 0))
    labelled = Boxes.from_array(np.concatenate((cars.array(), van.array())), np.array(["Car", "Car", "Van"]))
    sweep = sim_to_real.RealSweep("000001", np.ones((5, 4), np.float32), found, truth_of(frame(labelled)))
    row = {(row.label, row.kind, row.iou): row for row in sim_to_real.score_sweeps(second(small_config()), [sweep])}
    assert row["Car", "3d", 0.5] == sim_to_real.RealScore(
        "Car", "3d", 0.5, targets=2, found=2, false_positives=1, ap=1.0
    )
    assert (row["Car", "3d", 0.7].found, row["Car", "3d", 0.7].false_positives) == (1, 2)
    assert row["Pedestrian", "3d", 0.5].ap is None
    several = sim_to_real.score_sweeps(second(small_config()), [sweep, sweep, sweep])
    assert next(row for row in several if (row.label, row.kind, row.iou) == ("Car", "3d", 0.5)).low == 1
    assert [car.found_at for car in sim_to_real.tell_frame(sweep).cars] == [(0.5, 0.7), (0.5,)]


def test_a_folder_of_kitti_and_a_dataset_are_read_with_the_same_sweeps(tmp_path: Path) -> None:
    recipe = Recipe(town="suburb", seed=5, cavs=1, warmup_s=30.0, spins_per_scene=2, vehicle_rig=RIGS["kitti_lidar"])
    record(EmbeddedSource(recipe), tmp_path / "data")
    network = second(small_config()).eval()
    sweeps = list(sim_to_real.read_sweeps(network, tmp_path / "data"))
    ahead, around = sweeps[0], next(iter(sim_to_real.read_sweeps(network, tmp_path / "data", around=True)))
    assert len(sweeps) == 2
    assert len(around.truth.targets) >= len(ahead.truth.targets) > 0
    np.testing.assert_array_equal(around.points, ahead.points)
    (tmp_path / "kitti" / "training" / "velodyne").mkdir(parents=True)
    with pytest.raises(InputError, match="labels lie ahead, in the image; leave --around out"):
        next(sim_to_real.read_sweeps(network, tmp_path / "kitti", around=True))
