"""Offsets of clocks on constructed drives: a vehicle and a car pass a road sensor."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flcav.fusion.average import Navigation, Sighting
from flcav.fusion.pose_graph import LEAST_SPEED_MPS, ObjectPath, set_clocks, trace_objects
from flcav.geometry import Boxes, inverse, pose

TIMES = (0.0, 0.5, 1.0, 1.5)
EXACT = Navigation(0.05, 0.001)
POLE = pose(0.0, 20.0, 6.0)


def cars(*places: tuple[float, float]) -> Boxes:
    """Return cars at places (x, y), world frame, surely found."""
    count = len(places)
    center = np.column_stack((np.array(places).reshape(-1, 2), np.full(count, 0.75)))
    size = np.tile((4.4, 1.8, 1.5), (count, 1))
    return Boxes(center, size, np.zeros(count), np.full(count, "Car"), np.full(count, 0.9))


def drive(offset_s: float, ego_mps: float, car_mps: float) -> list[Sighting]:
    """Return what a road sensor and a vehicle of a fast clock tell; the car that both see drives the other way."""
    told = []
    for time in TIMES:
        ego, car = (ego_mps * time, -2.0), (30.0 - car_mps * time, 2.0)
        world = pose(*ego)
        told.append(Sighting("pole", time, POLE, cars(ego, car).transform(inverse(POLE))))
        seen = cars(car).transform(inverse(world))
        told.append(Sighting("cav0", time + offset_s, world, seen, navigation=EXACT))
    return told


def corrected(sightings: list[Sighting]) -> np.ndarray:
    return np.array([each.time_s for each in set_clocks(sightings, TIMES[-1]) if each.agent == "cav0"])


@given(offset_s=st.floats(-0.4, 0.4), ego_mps=st.floats(8, 15), car_mps=st.sampled_from((0.0, 10.0)))
def test_a_clock_is_set_by_the_vehicle_s_own_way(offset_s: float, ego_mps: float, car_mps: float) -> None:
    off = corrected(drive(offset_s, ego_mps, car_mps)) - TIMES
    np.testing.assert_allclose(off, off[0], atol=1e-9)
    assert abs(off[0]) <= max(0.04, 0.0 if abs(offset_s) > 0.06 else abs(offset_s))


@pytest.mark.parametrize("offset_s", [-0.3, 0.2])
def test_a_clock_of_a_standing_vehicle_is_set_by_a_car_that_passes(offset_s: float) -> None:
    np.testing.assert_allclose(corrected(drive(offset_s, 0.0, 12.0)), TIMES, atol=0.04)


def test_what_stands_tells_nothing() -> None:
    sightings = drive(0.3, 0.0, 0.0)
    np.testing.assert_allclose(corrected(sightings), np.array(TIMES) + 0.3)
    assert trace_objects([each for each in sightings if each.navigation is None], 0.0) == []
    slow = [each for each in drive(0.0, 0.9 * LEAST_SPEED_MPS, 0.0) if each.navigation is None]
    assert trace_objects(slow, 0.0) == []


def test_road_sensors_keep_their_time_and_without_any_nothing_is_set() -> None:
    sightings = drive(0.2, 10.0, 10.0)
    assert [each.time_s for each in set_clocks(sightings, 1.5) if each.agent == "pole"] == [*TIMES]
    alone = [each for each in sightings if each.agent == "cav0"]
    assert set_clocks(alone, 1.5) == alone


def test_a_vehicle_that_is_not_sure_of_its_place_is_not_set_by_its_way() -> None:
    unsure = [
        replace(each, boxes=Boxes.empty(), navigation=each.navigation and Navigation(5.0, 0.001))
        for each in drive(0.2, 10.0, 10.0)
        if each.agent == "cav0"
    ]
    poles = [each for each in drive(0.2, 10.0, 10.0) if each.agent == "pole"]
    np.testing.assert_allclose(corrected([*poles, *unsure]), np.array(TIMES) + 0.2)


def test_a_trace_is_straight_between_instants_and_ends_soon_after_them() -> None:
    trace = ObjectPath(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [10.0, 4.0]]))
    np.testing.assert_allclose(trace.place_at(np.array([0.25, 1.5])), [[2.5, 1.0], [15.0, 6.0]])
    assert np.isinf(trace.place_at(np.array([-0.7, 1.7]))).all()
