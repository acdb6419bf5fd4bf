"""Roadside units as members of a group: what they see in the frame of the vehicles' network, and who may have them."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flcav.config import InputError
from flcav.geometry import Boxes, points_in_boxes, pose
from flcav.perception.objects.config import pillars_config
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.extras.groups import roadside
from flcav.runs.extras.groups.forming import find_units
from flcav.runs.extras.groups.roadside import label_roadside, lower_sweep
from flcav.runs.frames import Frames
from flcav.runs.recipe import RunRecipe
from flcav.sensors.frame import Annotations, Calibration, Frame

CONFIG = pillars_config()
GROUND_M = 2.0  # of the town there


def seen_by_pole() -> tuple[Frame, Boxes]:
    """Return the sweep of a pole at (100, 50), 6 m above the ground and turned left, of a car 12 m ahead of it."""
    rng, world_from_pole = np.random.default_rng(0), pose(100, 50, GROUND_M + 6, np.pi / 2)
    car = Boxes.from_array(np.array([[100.0, 62.0, GROUND_M + 0.8, 4.4, 1.8, 1.6, 0.3]]), "car")
    on_car = rng.uniform((99.4, 61.4, GROUND_M + 0.5), (100.6, 62.6, GROUND_M + 1.5), (60, 3))
    floor = np.c_[rng.uniform((92, 52), (108, 58), (900, 2)), np.full(900, GROUND_M)]
    world = np.concatenate([on_car, floor])
    local = (world - world_from_pole[:3, 3]) @ world_from_pole[:3, :3]
    points = np.c_[local, np.full(len(local), 0.3)].astype(np.float32)
    mounts = Calibration({"lidar": pose(0, 0, 0)})
    nobody = Annotations(
        np.zeros(0, str), Boxes.empty(), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros(0)
    )
    return Frame("s", 0, 0.0, "pole7", world_from_pole, mounts, mounts, {"lidar": points}, nobody), car


def test_a_sweep_from_a_pole_is_as_high_above_the_ground_as_a_vehicle_s() -> None:
    frame, car = seen_by_pole()
    seen = lower_sweep(frame, "lidar", GROUND_M, CONFIG)
    points = seen.lidar["lidar"]
    assert points[60:, 2] == pytest.approx(CONFIG.ground_z_m, abs=1e-5)  # the floor
    world = seen.world_from_sensor("lidar")
    back = points[:, :3] @ world[:3, :3].T + world[:3, 3]
    assert points_in_boxes(back[:60], car).all()
    np.testing.assert_allclose(points[:, :2], frame.lidar["lidar"][:, :2])
    assert frame.lidar["lidar"][60, 2] == pytest.approx(-6, abs=1e-5)  # the recorded sweep stays


def test_units_learn_what_their_own_detector_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, car = seen_by_pole()
    keys = [SimpleNamespace(scene="s", index=number, agent="pole7") for number in (0, 1)]
    split = Frames(cast(Any, SimpleNamespace(frame=lambda _: frame, keys=keys)), (), {7: (0, 1), 8: ()})
    monkeypatch.setattr(roadside, "road_detector", lambda _: lambda _: car)
    monkeypatch.setattr(roadside, "DatasetGround", lambda _: SimpleNamespace(relief=None, below=lambda _: GROUND_M))
    found = label_roadside(split, (7, 8), {("s", 0)}, CONFIG, "grid")
    assert [*found] == ["grid/pole7"]
    (sample,) = found["grid/pole7"]
    assert sample.boxes.label.tolist() == ["Car"]
    assert sample.boxes.center[0] == pytest.approx([12.0, 0.0, CONFIG.ground_z_m + 0.8], abs=1e-6)  # ahead of the pole
    assert sample.boxes.yaw[0] == pytest.approx(0.3 - np.pi / 2)
    assert points_in_boxes(sample.points[:, :3], sample.boxes).sum() >= 60
    assert sample.free is not None
    assert len(sample.free) > 100  # the floor that it saw
    assert sample.exact is not None
    assert sample.exact.all()


def test_units_out_of_range_of_whoever_asked_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    sites = SimpleNamespace(number=np.array([3, 7]), position=np.array([[0.0, 0, 6], [500.0, 0, 6]]))
    monkeypatch.setattr("flcav.runs.extras.groups.forming.find_sites", lambda *_: sites)
    inputs, there = cast(Any, SimpleNamespace(recorded=False)), {"grid/cav0": np.array([40.0, 0, 0])}
    assert find_units(cast(Any, None), inputs, (3, 7), there, ["grid/cav0"], 100.0) == [3]
    assert find_units(cast(Any, None), inputs, (7,), there, ["grid/cav0"], 100.0) == []


@pytest.mark.parametrize(("labels", "fits"), [("road", True), ("road+tracks", True), ("tracks", False)])
def test_units_join_where_labels_are_their_detector_s(labels: str, fits: bool) -> None:
    asked = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"labels": labels, "plan": {"samples": 4, "edge_rounds": 2, "cloud_rounds": 1}}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
            "budgets_mb": {"wireless": 9, "wireline": 9},
            "federation": {"requests": {"roadside": True}},
        }
    )
    if fits:
        check_federations(asked, resolve_settings(asked).values())
    else:
        with pytest.raises(InputError, match="choose 'road' or 'road\\+tracks'"):
            check_federations(asked, resolve_settings(asked).values())
