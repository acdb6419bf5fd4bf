import numpy as np
import pytest

from flcav.fusion.distillation import LANE_RAD, build_context, snap_to_map
from flcav.geometry import Boxes
from flcav.world.map.layers import Crossing, MapLane, MapLayers

LANE = MapLane("l", "driving", np.array([(0.0, 0.0), (50.0, 0.0)]), 3.5, 13.9, "", "", "", ())
BACK = MapLane("b", "driving", np.array([(50.0, 3.5), (0.0, 3.5)]), 3.5, 13.9, "", "", "", ())
ZEBRA = np.array([(20.0, -2.0), (24.0, -2.0), (24.0, 6.0), (20.0, 6.0)])


@pytest.fixture(scope="module")
def context():
    crossing = Crossing("c", ZEBRA, np.array([(22.0, -2.0), (22.0, 6.0)]), 4.0)
    return build_context(MapLayers((), (), (LANE, BACK), (), (crossing,), ()))


def one(x, y, yaw, label="car", variance=0.01):
    rows = np.array([[x, y, 0.8, 4.4, 1.8, 1.6, yaw]])
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], np.array([label]), np.array([0.9]), np.full((1, 7), variance))


STILL = np.zeros((1, 2))


def test_a_heading_is_joined_with_its_lane_by_inverse_variance(context) -> None:
    snapped = snap_to_map(one(10.0, 0.4, 0.2), STILL, context)
    weight = (1 / 0.01) / (1 / 0.01 + 1 / LANE_RAD**2)
    np.testing.assert_allclose(snapped.yaw, [0.2 * weight])
    assert snapped.variance is not None
    np.testing.assert_allclose(snapped.variance[0, 6], 1 / (1 / 0.01 + 1 / LANE_RAD**2))


def test_a_reversed_car_is_turned_and_the_other_lane_leads_back(context) -> None:
    assert abs(snap_to_map(one(10.0, 0.0, np.pi - 0.1), STILL, context).yaw[0]) < 0.05
    assert abs(abs(snap_to_map(one(10.0, 3.6, 0.1), STILL, context).yaw[0]) - np.pi) < 0.05


@pytest.mark.parametrize(("x", "y", "yaw"), [(10.0, 9.0, 0.2), (10.0, 0.0, 1.2)], ids=["off the lanes", "across"])
def test_what_follows_no_lane_stays(context, x: float, y: float, yaw: float) -> None:
    assert snap_to_map(one(x, y, yaw), STILL, context).yaw[0] == yaw


@pytest.mark.parametrize(
    ("label", "x", "speed", "snapped"),
    [
        ("Cyclist", 22.0, 1.2, "Pedestrian"),
        ("Pedestrian", 10.0, 6.0, "Cyclist"),
        ("Cyclist", 22.0, 6.0, "Cyclist"),
        ("Pedestrian", 10.0, 1.2, "Pedestrian"),
        ("bicycle", 22.0, 0.0, "pedestrian"),
    ],
)
def test_people_are_what_place_and_speed_agree_on(context, label: str, x: float, speed: float, snapped: str) -> None:
    found = snap_to_map(one(x, 0.0, 0.0, label), np.array([(speed, 0.0)]), context)
    assert found.label.tolist() == [snapped]
