"""Scenery: kinds of junctions, conflict points as traffic engineering counts them, and the lane that a place is on."""

from collections import Counter

import numpy as np
import pytest

from flcav.odd.scenery import Scenery
from flcav.world.map.town import load_town


def test_conflict_points_are_those_of_the_textbook(ring: Scenery):
    # FHWA, Roundabouts: An Informational Guide, exhibits 5-1 and 5-2: 32 at a cross-road, 9 at a T, 8 at a roundabout
    found = {(place.kind, place.conflicts) for place in ring.places() if place.kind != "none"}
    assert found == {("crossroad", 32), ("t_junction", 9), ("roundabout", 8)}


def test_all_four_kinds_of_places_are_found(ring: Scenery):
    counts = Counter(place.kind for place in ring.places())
    assert counts == {"none": 10, "t_junction": 3, "roundabout": 1, "crossroad": 1}
    assert {place.control for place in ring.places() if place.kind == "crossroad"} == {"signalised"}


def test_a_place_is_what_is_measured_there(ring: Scenery):
    places = ring.places()
    seen = ring.measure(np.array([(place.x, place.y) for place in places]), np.array([place.yaw for place in places]))
    assert seen["junction"].tolist() == [place.kind for place in places]
    assert seen["junction_control"].tolist() == [place.control for place in places]


def test_a_scenario_starts_on_the_lane_that_leads_to_its_place(ring: Scenery):
    for place in ring.places():
        x, y, _ = place.start
        before = np.hypot(place.approach[0] - x, place.approach[1] - y)
        assert 15 < before <= 40.01, place
        assert not np.isnan(ring.measure(np.array([(x, y)]), np.array([place.start[2]]))["speed_limit"][0])


def test_of_two_lanes_that_of_the_own_direction_counts():
    scenery = Scenery(load_town("arterial"))
    edge = next(each for each in scenery.net.streets if each.type == "fast" and len(each.lanes_of("driving")) > 0)
    lane = edge.lanes_of("driving")[-1]
    middle = lane.shape[len(lane.shape) // 2 - 1 : len(lane.shape) // 2 + 1].mean(axis=0)
    step = lane.shape[1] - lane.shape[0]
    seen = scenery.measure(middle[None], np.arctan2(step[1:], step[:1]))
    assert seen["speed_limit"][0] == round(lane.speed * 3.6)
    assert seen["lanes"][0] == len(edge.lanes_of("driving"))


def test_far_from_any_street_the_drivable_area_is_missing(ring: Scenery):
    seen = ring.measure(np.array([(1e4, 1e4)]), np.zeros(1))
    assert np.isnan(seen["speed_limit"][0])
    assert seen["drivable_area_type"][0] == ""
    assert seen["junction"][0] == "none"


def test_slopes_are_those_of_the_relief():
    hills = Scenery(load_town("hilly_ring"))
    place = next(each for each in hills.places() if each.kind == "roundabout")
    at, yaw = np.array([place.approach]), np.array([place.yaw])
    ahead = at + 5 * np.array([[np.cos(place.yaw), np.sin(place.yaw)]])
    behind = 2 * at - ahead
    rise = hills.town.ground(*ahead[0]) - hills.town.ground(*behind[0])
    assert hills.measure(at, yaw)["gradient"][0] == pytest.approx(10 * abs(rise))
    assert abs(rise) > 0.1
