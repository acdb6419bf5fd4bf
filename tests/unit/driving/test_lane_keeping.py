"""The lane that a camera sees: its centre between lines, when it is believed, and that the driver steers along it."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from test_closed_loop import CAR, at, see, straight

from flcav.arrays import Array
from flcav.config import InputError
from flcav.driving.driver import decide_controls
from flcav.driving.lines.lane_keeping import FITTED_M, LEAST, STATIONS_M, SeenLane, find_centres, fit_lane
from flcav.driving.networks import find_lines, load_road_network
from flcav.driving.scenarios import find_scenarios
from flcav.driving.studies import lane_gain
from flcav.driving.studies.lane_gain import LaneTally, compare_aside, summarise_aside, summarise_centres
from flcav.geometry import left_vectors
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar32
from flcav.world.map.roads import Route
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.trace import empty_trace

WIDTH = 3.5  # of the lane of `straight`


def line(left_m: float, first: float = 0.0, last: float = 100.0, slope: float = 0.0) -> Array:
    """Return a line beside the x axis, or at a slope to it, world frame [m]."""
    x = np.arange(first, last, 0.7)
    return np.column_stack((x, left_m + slope * x))


def curve(radius_m: float, left_m: float) -> Array:
    """Return a line at a distance to the left of a circle that bends to the left, world frame [m]."""
    turn = np.linspace(0.0, 1.0, 200)
    centre = radius_m * np.column_stack((np.sin(turn), 1 - np.cos(turn)))
    return centre + left_m * left_vectors(turn)


def test_the_centre_is_midway_between_two_lines() -> None:
    centres = find_centres([line(1.65), line(-1.95)], straight(), 20.0)
    np.testing.assert_allclose(centres, -0.15, atol=1e-9)
    far = find_centres([line(1.65), line(-1.95), line(5.1), line(-5.4)], straight(), 20.0)  # of other lanes
    np.testing.assert_allclose(far, centres)


@pytest.mark.parametrize(("left_m", "centre"), [(2.0, 0.25), (-1.5, 0.25)])
def test_half_a_lane_from_a_line_alone(left_m: float, centre: float) -> None:
    np.testing.assert_allclose(find_centres([line(left_m)], straight(), 20.0), centre, atol=1e-9)


def test_of_two_lines_that_are_no_lane_apart_the_nearer_counts() -> None:
    np.testing.assert_allclose(find_centres([line(1.5), line(-0.4)], straight(), 20.0), WIDTH / 2 - 0.4, atol=1e-9)


def test_in_a_curve_lines_are_cut_across_the_route() -> None:
    points = curve(40.0, 0.0)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    route = Route(points, along, np.full(200, 10.0), (), np.full(200, WIDTH))
    centres = find_centres([curve(40.0, 1.85), curve(40.0, -1.65)], route, 2.0)
    np.testing.assert_allclose(centres, 0.1, atol=0.02)


def test_no_centre_beyond_a_line_and_without_any() -> None:
    ends = find_centres([line(1.75, last=30.0)], straight(), 20.0)
    assert np.isfinite(ends[STATIONS_M < 9.0]).all()
    assert np.isnan(ends[STATIONS_M > 10.0]).all()
    assert np.isnan(find_centres([], straight(), 20.0)).all()


def test_a_lane_is_the_line_through_its_centres() -> None:
    lane = fit_lane(0.4 - 0.02 * STATIONS_M, straight(), 20.0)
    assert lane is not None
    assert (lane.from_m, lane.to_m) == (20.0, 20.0 + FITTED_M)
    for along, aside in ((20.0, 0.4), (30.0, 0.2)):
        np.testing.assert_allclose(lane.at(along), (along, aside, np.arctan(-0.02)), atol=1e-9)


def test_a_lane_that_is_seen_too_little_or_leads_elsewhere_is_not_followed() -> None:
    few = np.where(np.arange(len(STATIONS_M)) < LEAST - 1, 0.2, np.nan)
    assert fit_lane(few, straight(), 20.0) is None
    assert fit_lane(-1.0 + 0.12 * STATIONS_M, straight(), 20.0) is None
    assert fit_lane(np.full(len(STATIONS_M), 1.2), straight(), 20.0) is None
    wrong = np.where(STATIONS_M == 7.0, -1.6, 0.2)  # one place at which another line was met
    lane = fit_lane(wrong, straight(), 20.0)
    assert lane is not None
    assert (lane.aside_m, lane.slope) == pytest.approx((0.2, 0.0))


def test_the_driver_steers_along_the_lane_as_far_as_it_is_seen() -> None:
    lane = SeenLane(straight(), 20.0, 36.0, 0.5, 0.0)
    told = decide_controls(straight(), at(20.0, 8.0), replace(see(), lane=lane), CAR)
    moved = decide_controls(straight(), replace(at(20.0, 8.0), y=-0.5), see(), CAR)  # the same seen from the lane
    assert told.steered == "lane"
    assert told.controls.steer == pytest.approx(moved.controls.steer)
    near = replace(lane, to_m=26.0)  # nearer than the place that it aims at
    by_map = decide_controls(straight(), at(20.0, 8.0), replace(see(), lane=near), CAR)
    assert (by_map.steered, by_map.controls.steer) == ("route", 0.0)


def test_around_who_stands_the_lane_does_not_count() -> None:
    wide = shapely.box(0.0, -1.75, 300.0, 5.25)
    beside = see((50.0, -(CAR.size[1] / 2 + 0.3 + 0.9), 0.0, 0.0, 0.0))
    lane = SeenLane(straight(), 36.0, 52.0, -0.5, 0.0)
    told = decide_controls(straight(), at(36.0, 8.0), replace(beside, lane=lane), CAR, lanes=wide)
    assert told.steered == "beside"
    assert told.controls.steer > 0


def test_a_rig_without_a_camera_is_refused() -> None:
    scene = Scene(load_town("ring"), empty_trace("ring"))
    frame = observe(scene, lidar32(), "pole1", 0, scene_name="x", seed=1, number=0)
    with pytest.raises(InputError, match="the vehicle's rig has no camera 'camera', which its lane is seen by"):
        find_lines(frame, load_road_network())


def test_lateral_errors_are_means_over_steps_and_differences_are_paired() -> None:
    first = [LaneTally([0.1, -0.3], ["route"] * 2), LaneTally([0.2], ["route"])]
    second = [LaneTally([0.2, -0.4], ["lane", "route"]), LaneTally([-0.6, 0.0], ["lane"] * 2)]
    found = summarise_aside(first)
    assert (found.mean_m.mean, found.steps, found.seen) == pytest.approx((0.2, 3, 0.0))
    assert summarise_aside(second).seen == 0.75
    more = compare_aside(first, second)
    assert more.mean == pytest.approx(0.3 - 0.2)
    assert (more.low, more.high) == pytest.approx((0.1, 0.1))  # both drives alike
    assert compare_aside(first[:1], second[:1]).low is None


def test_drives_in_which_nobody_moves_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    pool = SimpleNamespace(map=lambda work, *given: [(SimpleNamespace(scenario="x"), LaneTally())] * 2)
    monkeypatch.setattr(lane_gain, "process_pool", lambda *_: nullcontext(pool))
    with pytest.raises(InputError, match="no vehicle reaches 1 m/s in these drives; let them last longer"):
        lane_gain.measure_lane_gain(find_scenarios(["ring-none-clear"]), [1])


def test_errors_of_centres_by_distance() -> None:
    centres = np.full((2, len(STATIONS_M)), np.nan)
    centres[0, (STATIONS_M >= 10) & (STATIONS_M < 15)] = (0.1, -0.3, 0.1, 0.1, np.nan)
    row = summarise_centres(centres, 10.0, 15.0)
    assert (row.seen, row.mean_m, row.bias_m) == pytest.approx((0.4, 0.15, 0.0))
    assert summarise_centres(centres, 5.0, 10.0).mean_m is None
