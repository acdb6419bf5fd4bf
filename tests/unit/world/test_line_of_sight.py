"""Line of sight past one building and one van, whose shadows are known."""

import numpy as np
import pytest

from flcav.world.line_of_sight import count_visible_actors, find_viewshed, find_visible_pairs

HOUSE = np.array([[20.0, 0.0, 0.0, 10.0, 10.0, 10.0]])  # x 15-25, y -5-5, 10 m high
SITES = np.array([[0.0, 0.0, 5.0], [20.0, 30.0, 5.0]])
PLACES = np.array([[40.0, 0.0, 1.0], [10.0, 0.0, 1.0], [40.0, 40.0, 1.0]])
PAIRS = (np.array([0, 0, 0, 1, 1, 1]), np.array([0, 1, 2, 0, 1, 2]))


def test_a_building_hides_what_is_behind_it(small_town):
    seen = find_visible_pairs(small_town(buildings=HOUSE), [], SITES, PLACES, PAIRS)
    assert seen.reshape(2, 3).tolist() == [[False, True, True], [True, True, True]]


def test_a_viewshed_is_the_ground_within_range_that_no_building_hides(small_town):
    found = find_viewshed(small_town(buildings=HOUSE), [], SITES[0], 50.0)
    x, y = np.meshgrid(found.x, found.y)
    within = np.sqrt(x**2 + y**2 + 4.0**2) <= 50.0  # from 5 m height to 1 m
    shadow = (x > 28.0) & (np.abs(y) < x / 3)  # between the lines through the corners (15, -5) and (15, 5)
    open_ = (x < 15.0) | (np.abs(y) > x / 3 + 1.0)
    assert not found.seen[~within | shadow].any()
    assert found.seen[within & open_].mean() > 0.99  # a mast hides a line


def test_traffic_hides_where_it_stands_at_half_of_the_instants(small_town, standing):
    town, site, place = small_town(), np.array([[0.0, 0.0, 1.5]]), np.array([[30.0, 0.0, 0.8]])
    pair = (np.zeros(1, np.int64), np.zeros(1, np.int64))
    van = standing([("van0", "van", 0, 12.0, 0.0, np.pi / 2)])
    assert find_visible_pairs(town, [], site, place, pair).tolist() == [True]
    assert find_visible_pairs(town, [van], site, place, pair).tolist() == [False]
    assert find_visible_pairs(town, [van, standing([])], site, place, pair).tolist() == [True]


def test_actors_count_where_they_are_near_and_seen(small_town, standing):
    cars = [("a", "car", 0, 12.0, 0.0, 0.0), ("b", "car", 0, 40.0, 0.0, 0.0), ("c", "car", 0, 40.0, 40.0, 0.0)]
    found = count_visible_actors(small_town(buildings=HOUSE), [standing(cars)], SITES, [20.0, 45.0])
    assert found[0].tolist() == pytest.approx([1.0, 1.0])  # b is behind the house, c 57 m away
    assert found[1].tolist() == pytest.approx([0.0, 3.0])  # past the house's corner to a, 31 m; b, 36 m; c, 23 m
    assert not count_visible_actors(small_town(), [], SITES, [20.0]).any()
