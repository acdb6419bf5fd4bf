"""The way around who stands, and the tracks that are believed."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import shapely
from test_closed_loop import CAR, at, see, straight

from flcav.driving.driver import decide_controls
from flcav.driving.following import CERTAIN, CONFIRMED, Confirmed, Following
from flcav.driving.lines.passing import CREEPS_MPS, SLIM_M, Beside, join_lanes, list_lines
from flcav.geometry import Boxes
from flcav.world.map.town import load_town

WIDE, NARROW = shapely.box(0.0, -1.75, 300.0, 5.25), shapely.box(0.0, -1.75, 300.0, 1.75)


def parked(aside_m: float) -> float:
    """Return where the middle of a parked car is whose side is `aside_m` right of a passing vehicle's [m]."""
    return -(CAR.size[1] / 2 + aside_m + 1.8 / 2)


def test_a_parked_car_that_reaches_into_the_margin_is_passed_further_left() -> None:
    beside = see((50.0, parked(0.3), 0.0, 0.0, 0.0))
    stops = decide_controls(straight(), at(36.0, 8.0), beside, CAR)
    goes = decide_controls(straight(), at(36.0, 8.0), beside, CAR, lanes=WIDE)
    assert stops.acceleration < -1.0
    assert (stops.cause, stops.controls.steer) == (0, 0.0)
    assert goes.acceleration > 0
    assert goes.controls.steer > 0


def test_without_room_who_stands_is_passed_slowly_and_who_is_in_the_way_not_at_all() -> None:
    narrow, closed = (see((40.0, parked(gap), 0.0, 0.0, 0.0)) for gap in (SLIM_M + 0.1, -1.0))
    for speed, goes in ((0.0, True), (CREEPS_MPS - 0.5, True), (8.0, False)):
        told = decide_controls(straight(), at(36.0, speed), narrow, CAR, lanes=NARROW)
        assert (told.acceleration > 0) == goes, speed
    assert decide_controls(straight(), at(36.0, 0.0), closed, CAR, lanes=NARROW).acceleration <= 0.3
    ahead = see((46.0, 0.0, 0.0, 0.0, 0.0))
    told = decide_controls(straight(), at(36.0, 6.0), ahead, CAR, lanes=NARROW)
    assert told.acceleration < -1.0
    assert told.cause == 0


@pytest.mark.parametrize("label", ["pedestrian", "Pedestrian"])
def test_nobody_squeezes_past_somebody_on_foot(label: str) -> None:
    beside = see((42.0, parked(0.3), 0.0, 0.0, 0.0))
    afoot = replace(beside, boxes=replace(beside.boxes, label=np.array([label])))
    told = decide_controls(straight(), at(36.0, 6.0), afoot, CAR, lanes=WIDE)
    assert (told.acceleration, told.controls.steer) == (
        decide_controls(straight(), at(36.0, 6.0), afoot, CAR).acceleration,
        0.0,
    )


def test_oncoming_traffic_keeps_the_vehicle_in_its_lane() -> None:
    beside = (50.0, parked(0.0), 0.0, 0.0, 0.0)
    oncoming = (70.0, 2.5, np.pi, -8.0, 0.0)
    free, met = (
        decide_controls(straight(), at(36.0, 8.0), see(*rows), CAR, lanes=WIDE)
        for rows in ((beside,), (beside, oncoming))
    )
    assert free.controls.steer > 0.0
    assert met.acceleration < free.acceleration


@pytest.mark.parametrize(("left_m", "to_m"), [(0.0, 1.2), (0.4, -0.3), (1.0, 1.0)])
def test_a_line_beside_a_route_begins_at_the_vehicle_and_ends_parallel(left_m: float, to_m: float) -> None:
    line = Beside(straight(), 20.0, left_m, to_m, 9.0)
    assert line.at(20.0) == pytest.approx((20.0, left_m, 0.0))
    assert line.at(29.0) == pytest.approx((29.0, to_m, 0.0))
    x = np.linspace(20.0, 29.0, 2001)
    slope = np.gradient(line.at(x)[:, 1], x)
    assert line.at(x)[1:-1, 2] == pytest.approx(np.arctan(slope)[1:-1], abs=1e-3)


def test_lines_stay_within_the_lanes() -> None:
    width = CAR.size[1]
    aside = [line.to_m for line in list_lines(straight(), 30.0, 0.0, 8.0, width, NARROW)]
    assert aside
    assert max(aside) + width / 2 <= 1.75
    assert min(aside) - width / 2 >= -1.75
    assert max(line.to_m for line in list_lines(straight(), 30.0, 0.0, 8.0, width, WIDE)) > max(aside)


def test_the_lanes_of_a_town_hold_its_lanes_and_no_building() -> None:
    town = load_town("ring")
    lanes = join_lanes(town)
    assert lanes.area > 1000
    assert not shapely.contains_xy(lanes, *town.poles.position[:, :2].T).any()


def test_a_track_is_believed_after_three_of_five_sweeps() -> None:
    car = Boxes.from_array(np.array([[10.0, 3.0, 0.8, 4.5, 1.8, 1.6, 0.0]]), "Car", np.array([0.9]))
    found = [True, False, True, False, True, True, False, False, False]
    following = Following(None, None, CERTAIN, CONFIRMED)
    told = [
        len(following.step(car if each else Boxes.empty(), tick / 10, frozenset()).boxes)
        for tick, each in enumerate(found)
    ]
    oracle = [sum(found[max(i - 4, 0) : i + 1]) >= 3 for i in range(len(found))]
    assert [bool(each) for each in told] == oracle


CAR_BOX = Boxes.from_array(np.array([[0.0, 0.0, 0.8, 4.5, 1.8, 1.6, 0.0]]), "Car")
SOMEBODY = Boxes.from_array(np.array([[0.0, 0.0, 0.9, 0.6, 0.6, 1.8, 0.0]]), "Pedestrian")


@pytest.mark.parametrize(("mps", "tick", "moves"), [(0.3, 15, False), (5.0, 9, True), (1.0, 20, True)])
def test_a_car_stands_until_it_has_gone_farther_than_a_box_shifts(mps: float, tick: int, moves: bool) -> None:
    past = deque((i / 10, mps * i / 10, 0.0, 0.0, mps) for i in range(tick + 1))
    assert CONFIRMED.moves(past, CAR_BOX) == moves == (mps * tick / 10 > Confirmed.drove_m)
    assert CONFIRMED.moves(deque([(0.0, 0.0, 0.0, 0.0, 1.0), (0.5, 0.6, 0.0, 0.0, 1.0)]), SOMEBODY)
