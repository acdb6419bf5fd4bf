"""Obstacles of no class: boxes around made returns on the lanes, beside the same returns elsewhere or explained."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity

from flcav.driving.errors import load_error_model
from flcav.driving.obstacles import LEAST, OBSTACLE, REACH_M, clear_air, find_obstacles
from flcav.driving.studies.error_measurement import _outside
from flcav.geometry import Array, Boxes
from flcav.world.map.town import load_town

LANES = shapely.box(-50, -4, 50, 4)
TOWN = load_town("grid")
SENSOR = np.zeros(2)


def truck(x: float, y: float, yaw: float) -> Array:
    """Return the points (N, 3) of the back and the side of a truck of 8 x 2.5 m around x, y [m], 3 m high."""
    along, up = np.meshgrid(np.linspace(-4, 4, 30), np.linspace(0.1, 3.0, 12))
    across, high = np.meshgrid(np.linspace(-1.25, 1.25, 12), np.linspace(0.1, 3.0, 12))
    local = np.stack(
        (
            np.concatenate([along.ravel(), np.full(across.size, -4.0)]),
            np.concatenate([np.full(along.size, -1.25), across.ravel()]),
        )
    )
    plan = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ local
    return np.column_stack((plan.T + np.array([x, y]), np.concatenate([up.ravel(), high.ravel()])))


def found(points: Array, detected: Boxes | None = None) -> Boxes:
    return find_obstacles(points, SENSOR, detected or Boxes.empty(), LANES, TOWN)


@pytest.mark.parametrize("yaw", [0.0, 0.3, -0.2])
def test_a_truck_on_the_lanes_is_one_obstacle_around_its_returns(yaw: float) -> None:
    points = truck(15.0, 0.0, yaw)
    boxes = found(points)
    assert boxes.label.tolist() == [OBSTACLE]
    assert np.sort(boxes.size[0, :2]) == pytest.approx((2.5, 8.0), abs=0.2)  # orientations are 2 degrees apart
    assert np.sin(boxes.yaw[0] - yaw) == pytest.approx(0.0, abs=0.05)
    assert boxes.center[0, :2] == pytest.approx((15.0, 0.0), abs=0.1)
    assert boxes.center[0, 2] == pytest.approx(boxes.size[0, 2] / 2)  # it stands on the ground


def test_nothing_is_found_off_the_lanes_far_away_low_high_or_in_a_detection() -> None:
    points = truck(15.0, 0.0, 0.0)
    seen = Boxes.from_array(np.array([[15.0, 0.0, 1.5, 8.0, 2.5, 3.0, 0.0]]), "Car", np.ones(1))
    assert len(found(points)) == 1
    for moved in ((0.0, 20.0, 0.0), (REACH_M + 10.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, 0.0, -3.0)):
        assert not len(found(points + moved))
    assert not len(found(points, seen))
    standing = points[points[:, 2] > 0.6][: LEAST - 1]
    assert not len(found(standing))


def test_two_obstacles_apart_are_two_and_points_on_a_line_are_one() -> None:
    assert len(found(np.concatenate([truck(12.0, 0.0, 0.0), truck(25.0, 0.0, 0.0)]))) == 2
    wall = np.column_stack((np.full(400, 10.0), np.linspace(-1, 1, 400), np.full(400, 1.0)))
    assert found(wall).size[0, :2] == pytest.approx((2.0, 0.5), abs=0.02)


def test_faint_returns_that_are_near_are_air() -> None:
    sweep = np.array([[5, 0, 0, 0.001], [5, 0, 0, 0.1], [30, 0, 0, 0.001], [0, 0, -1.8, 0.0]], np.float32)
    np.testing.assert_array_equal(clear_air(sweep), sweep[1:3])


def test_drops_of_rain_around_the_vehicle_are_no_obstacle() -> None:
    """Some ten returns in each cell near the vehicle, as in heavy rain: thousands, and yet thin."""
    random = np.random.default_rng(2)
    away, angle = random.uniform(0.5, 5.0, 3000), random.uniform(-np.pi, np.pi, 3000)
    drops = np.column_stack((away * np.cos(angle), away * np.sin(angle), random.uniform(0.0, 3.0, 3000)))
    assert not len(found(drops))
    assert len(found(np.concatenate([drops, truck(10.0, 0.0, 0.0)]))) == 1


def test_errors_of_obstacles_are_outwards_from_the_outline() -> None:
    size, yaw = np.array([8.0, 2.5]), 0.4
    points = np.random.default_rng(1).uniform(-8, 8, (200, 2))
    outline = shapely.affinity.rotate(shapely.box(-4, -1.25, 4, 1.25), yaw, origin=(0, 0), use_radians=True)
    oracle = shapely.distance(outline, shapely.points(points))
    assert np.hypot(*_outside(points, size, yaw).T) == pytest.approx(oracle, abs=1e-9)


def test_the_packaged_errors_have_obstacles() -> None:
    model = load_error_model()
    assert 0.5 < model.detected[OBSTACLE][0] <= 1.0
    assert replace(model).sd[OBSTACLE][0] < 1.5
