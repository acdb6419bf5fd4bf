"""Networks on rigs unlike the one of their training: the sweep's height and direction, and looks to all four sides."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flcav.geometry import Boxes, pose, transform_points, wrap_angle
from flcav.perception.objects import predict as prediction
from flcav.perception.objects.config import tiny_config
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.predict import detect_all, detect_in, look_around
from flcav.perception.objects.samples import sample_from_frame
from flcav.perception.objects.truth import in_range, network_from_lidar
from flcav.sensors.frame import Calibration, Frame

from .frames import frame

PLACES = np.array([[30.0, 5], [4, 31], [-40, -3], [-20, 21], [10, -12], [1, -46]])  # of cars, about the LiDAR [m]
CARS = [(f"car{i}", "car", float(x), float(y), 40) for i, (x, y) in enumerate(PLACES)]


def mounted(mount: np.ndarray, agent: str = "cav0") -> Frame:
    """Return a frame with a point at each car's centre, seen by a LiDAR with this mount."""
    ground = frame(CARS, agent=agent)
    world = ground.annotations.boxes.center
    cloud = np.c_[transform_points(np.linalg.inv(mount), world), np.zeros(len(world))].astype(np.float32)
    calibration = Calibration({"top": mount})
    return replace(ground, calibration=calibration, assumed=calibration, lidar={"top": cloud})


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Replace the network by one that finds a car, heading ahead, at every point ahead; return what it looks at."""
    looked: list[np.ndarray] = []

    def find(network, clouds, score_threshold, batch):
        looked.extend(clouds)
        rows = [np.c_[cloud[:, :3], np.tile([4.0, 2, 1.5, 0], (len(cloud), 1))] for cloud in clouds]
        ahead = replace(network.config, around=False)
        found = [Boxes.from_array(row, "Car", np.linspace(0.9, 0.5, len(row))) for row in rows]
        return [boxes[in_range(boxes, ahead)] for boxes in found]

    monkeypatch.setattr(prediction, "_detect_ahead", find)
    return looked


def test_four_looks_find_what_is_on_every_side_once(seen: list[np.ndarray]):
    network, cloud = second_tiny(), np.c_[PLACES, np.zeros((len(PLACES), 2))].astype(np.float32)
    (ahead,), (found,) = detect_all(network, [cloud]), detect_all(look_around(network), [cloud])
    assert sorted(map(tuple, ahead.center[:, :2])) == [(10, -12), (30, 5)]
    assert not network.config.around
    np.testing.assert_allclose(found.center[np.lexsort(found.center.T), :2], PLACES[np.lexsort(PLACES.T)])
    assert in_range(found, look_around(network).config).all()
    for center, yaw in zip(found.center, found.yaw, strict=True):  # ahead was where it looked
        away = abs(wrap_angle(math.atan2(center[1], center[0]) - yaw))
        assert away < math.pi / 4 or np.abs(center[:2]).max() < 24
    assert len(seen) == 5
    np.testing.assert_array_equal(np.sort(np.hypot(*seen[2][:, :2].T)), np.sort(np.hypot(*cloud[:, :2].T)))


def test_what_lies_behind_the_corners_is_in_no_look():
    boxes = Boxes.from_array([[30, 30, 0, 4, 2, 1.5, 0], [-30, 20, 0, 4, 2, 1.5, 0], [20, -47, 0, 4, 2, 1.5, 0]], "Car")
    assert in_range(boxes, replace(tiny_config(), around=True)).tolist() == [False, True, True]


@pytest.mark.parametrize(
    "mount",
    [pose(1.2, 0.3, 2.3), pose(0, 0, 1.8, yaw=math.pi / 2), pose(0, 0, 1.4, yaw=-0.4), pose(0, 0, 1.8, pitch=0.1)],
    ids=["higher", "aside", "lower and turned", "tilted"],
)
def test_a_sweep_is_brought_to_the_frame_of_the_training(mount: np.ndarray, seen: list[np.ndarray]):
    """There the vehicle's x axis is ahead and its ground 1.8 m below; found boxes are in the LiDAR's frame again."""
    sweep = mounted(mount)
    (found,) = detect_in(second_tiny(), [sweep])
    world = sweep.annotations.boxes.center
    expected = world - [mount[0, 3], mount[1, 3], 1.8]
    np.testing.assert_allclose(seen[0][:, :3], expected, atol=1e-5)
    kept = np.abs(transform_points(mount, found.center)[:, None] - world[None]).max(axis=2).min(axis=1)
    assert len(kept) == 2
    assert kept.max() < 1e-5
    sample = sample_from_frame(sweep, tiny_config())
    np.testing.assert_allclose(sample.boxes.center, expected, atol=1e-6)
    np.testing.assert_allclose(sample.boxes.yaw, sweep.annotations.boxes.yaw, atol=1e-2)


def test_a_mount_as_in_training_and_a_pole_s_are_left_as_they_are():
    assert network_from_lidar(mounted(pose(0, 0, 1.75, pitch=0.02)), tiny_config()) is None
    assert network_from_lidar(mounted(pose(0, 0, 0), agent="pole3"), tiny_config()) is None
    assert network_from_lidar(mounted(pose(0, 0, 0)), tiny_config()) is not None
