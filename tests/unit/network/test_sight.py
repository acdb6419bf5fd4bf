"""States of paths: against dense samples of the segment, against rays through the town's mesh, and along a drive."""

from dataclasses import replace

import numpy as np
import pytest
from moving import make_trace, open_town
from scipy.optimize import linprog

from flcav.config import InputError
from flcav.geometry import Boxes, points_in_boxes, segments_meet_boxes
from flcav.network.radio import budget
from flcav.network.radio.budget import PathState, Radio
from flcav.network.radio.links import find_sight, link_vehicles, raise_walls, unit_positions, vehicle_boxes
from flcav.network.radio.recorded import cover_town
from flcav.statistics.streams import stream
from flcav.world.map.town import load_town

HOUSE = (50.0, 0.0, 0.3, 20.0, 12.0, 9.0)
UNIT = {"pole1": np.array([100.0, 0.0, 5.0])}
MEDIAN = Radio(shadowing=False)


def test_segments_meet_boxes_as_dense_samples_of_them_do():
    rng = np.random.default_rng(4)
    rows = np.c_[rng.uniform(-10, 10, (40, 3)), rng.uniform(0.5, 8, (40, 3)), rng.uniform(-4, 4, 40)]
    boxes = Boxes.from_array(rows, "x")
    starts, ends = rng.uniform(-12, 12, (200, 3)), rng.uniform(-12, 12, (200, 3))
    ends[:20, 2] = starts[:20, 2]  # level
    samples = starts[:, None] + np.linspace(0, 1, 800)[:, None] * (ends - starts)[:, None]
    inside = points_in_boxes(samples.reshape(-1, 3), boxes).reshape(40, 200, 800).any(axis=2).T
    near = points_in_boxes(samples.reshape(-1, 3), boxes, margin_m=0.05).reshape(40, 200, 800).any(axis=2).T
    found = segments_meet_boxes(starts, ends, boxes)
    assert found[inside].all()
    assert not found[~near].any()
    assert 500 < found.sum() < 7500


def test_segments_meet_tilted_boxes_where_linear_programming_finds_a_common_point():
    rng = np.random.default_rng(5)
    rows = np.c_[rng.uniform(-4, 4, (12, 3)), rng.uniform(1, 8, (12, 3)), rng.uniform(-4, 4, 12)]
    boxes = replace(Boxes.from_array(rows, "x"), tilt=rng.uniform(-0.6, 0.6, (12, 2)))
    starts, ends = rng.uniform(-9, 9, (30, 3)), rng.uniform(-9, 9, (30, 3))
    wanted = np.zeros((30, 12), np.bool_)
    for (i, j), _ in np.ndenumerate(wanted):
        inverse_pose = np.linalg.inv(boxes.pose(j))
        start, end = (inverse_pose[:3, :3] @ each[i] + inverse_pose[:3, 3] for each in (starts, ends))
        faces = np.r_[end - start, start - end][:, None]  # along the segment, within the six faces
        room = np.r_[boxes.size[j] / 2 - start, boxes.size[j] / 2 + start]
        wanted[i, j] = linprog([0.0], A_ub=faces, b_ub=room, bounds=[(0.0, 1.0)]).status == 0
    found = segments_meet_boxes(starts, ends, boxes)
    np.testing.assert_array_equal(found, wanted)
    upright = segments_meet_boxes(starts, ends, replace(boxes, tilt=None))
    assert 20 < found.sum() < 340
    assert (found != upright).sum() > 5


def test_vehicles_on_a_slope_block_as_tilted_boxes():
    level = make_trace([0.0], {"van1": [80.0, 0.0]}, {"van1": ("truck", 0)})
    pitch = -0.2
    boxes, actor = vehicle_boxes(replace(level, tilt=np.array([[[pitch, 0.0]]])), 0)
    length, _, height = level.size[0]
    ahead, up = np.array([np.cos(pitch), -np.sin(pitch)]), np.array([np.sin(pitch), np.cos(pitch)])
    assert actor.tolist() == [0]
    front_top = (80.0, 0.0) + length / 2 * ahead + height * up  # x, z
    assert (np.abs(boxes.corners()[0][:, [0, 2]] - front_top).max(axis=1) < 1e-9).any()
    over = np.array([[60.0, 0.0, front_top[1] - 0.05]]), np.array([[100.0, 0.0, front_top[1] - 0.05]])
    assert find_sight(*over, None, boxes).blocker.tolist() == [[0]]
    assert find_sight(*over, None, vehicle_boxes(level, 0)[0]).blocker.tolist() == [[-1]]


@pytest.mark.parametrize(
    ("start", "end", "meets"),
    [
        ((-2, 0, 0), (2, 0, 0), True),  # along an axis, through the middle
        ((-2, 1, 0), (2, 1, 0), True),  # along a face
        ((-2, 1.001, 0), (2, 1.001, 0), False),
        ((-2, 0, 0), (-1, 0, 0), True),  # ends on a face
        ((-2, 0, 0), (-1.01, 0, 0), False),
        ((0, 0, 0), (0, 0, 0), True),  # a point inside
        ((0, 0, 3), (0, 0, 3), False),
    ],
)
def test_segments_along_faces_and_points(start, end, meets):
    cube = Boxes.from_array([[0, 0, 0, 2, 2, 2, 0]], "x")
    assert segments_meet_boxes([start], [end], cube).tolist() == [[meets]]


@pytest.mark.parametrize("name", ["suburb", "grid"])
def test_buildings_block_what_goes_through_their_walls_and_nothing_that_passes_by(name):
    town = load_town(name)
    outline = np.concatenate(town.roads)
    corners = outline[:: max(len(outline) // 300, 1)]
    antennas = np.c_[corners, np.full(len(corners), 1.6)]
    sites = town.poles.position
    starts, ends = np.repeat(antennas, len(sites), axis=0), np.tile(sites, (len(antennas), 1))
    found = find_sight(antennas, sites, raise_walls(town), Boxes.empty()).state.ravel()
    x, y, yaw, length, width, height = town.buildings.T
    walls = np.where(height < 9, 0.68 * height, height - 0.5)  # below the roof
    inner = Boxes.from_array(np.c_[x, y, walls / 2, length, width, walls, yaw], "walls")
    outer = Boxes.from_array(np.c_[x, y, height / 2, length + 2.4, width + 2.4, height, yaw], "with balconies")
    assert (found[segments_meet_boxes(starts, ends, inner).any(axis=1)] == PathState.NLOS).all()
    assert (found[~segments_meet_boxes(starts, ends, outer).any(axis=1)] == PathState.LOS).all()
    assert 0.2 < (found == PathState.NLOS).mean() < 0.95


def test_a_drive_behind_a_truck_and_a_house():
    town = open_town(HOUSE)
    times = np.arange(4.0)
    drive = np.array([[95.0, 10.0], [70.0, 0.0], [20.0, 0.0], [np.nan, np.nan]])
    trace = make_trace(
        times, {"cav0": drive, "van1": [80.0, 0.0], "bike": [85.0, 0.0]}, {"van1": ("truck", 0), "bike": ("bicycle", 0)}
    )
    links = link_vehicles(town, trace, ["cav0"], UNIT, MEDIAN)
    assert links.state[:, 0, 0].tolist() == [PathState.LOS, PathState.NLOSV, PathState.NLOS, -1]
    assert links.present[:, 0].tolist() == [True, True, True, False]
    roof = 1.45
    lengths = [np.linalg.norm(UNIT["pole1"] - (*xy, roof)) for xy in drive[:3]]
    np.testing.assert_allclose(links.distance_m[:3, 0, 0], lengths)
    lg_f = np.log10(5.9)
    wanted = [
        38.77 + 16.7 * np.log10(lengths[0]) + 18.2 * lg_f,
        38.77 + 16.7 * np.log10(lengths[1]) + 18.2 * lg_f + 5,  # below the unit, not below the truck: case 3
        36.85 + 30 * np.log10(lengths[2]) + 18.9 * lg_f,
    ]
    np.testing.assert_allclose(links.loss_db[:3, 0, 0], wanted)
    assert links.loss_db[3, 0, 0] == np.inf
    assert links.rate_bps[3, 0, 0] == 0


def test_a_low_unit_behind_a_truck_is_below_it_like_the_car():
    trace = make_trace([0.0], {"cav0": [70.0, 0.0], "van1": [80.0, 0.0]}, {"van1": ("truck", 0)})  # 3.3 m high
    links = link_vehicles(open_town(HOUSE), trace, ["cav0"], {"low": np.array([100.0, 0.0, 2.8])}, MEDIAN)
    clear = budget.path_loss_db(links.distance_m, PathState.LOS, 5.9)
    assert (links.loss_db - clear).item() == pytest.approx(9.0)


def test_of_several_vehicles_in_the_path_the_tallest_counts():
    boxes = Boxes.from_array([[30, 0, 1, 5, 2, 2, 0], [40, 0, 1.5, 5, 2, 3, 0], [50, 0, 1, 5, 2, 2, 0]], "van")
    seen = find_sight(np.array([[0, 0, 1.0], [0, 9.0, 1.0]]), np.array([[90, 0, 1.2]]), None, boxes)
    assert (seen.state[:, 0].tolist(), seen.blocker[:, 0].tolist()) == ([PathState.NLOSV, PathState.LOS], [1, -1])


def test_a_vehicle_does_not_block_its_own_antenna():
    trace = make_trace([0.0, 1.0], {"cav0": [0.0, 0.0], "cav1": [10.0, 0.0]})
    links = link_vehicles(open_town(HOUSE), trace, ["cav0", "cav1"], {"near": np.array([-40.0, 0.0, 5.0])}, MEDIAN)
    assert links.state[0, :, 0].tolist() == [PathState.LOS, PathState.LOS]


@pytest.mark.slow
def test_shadowing_is_a_stream_of_its_own_for_each_link_and_has_the_clauses_statistics():
    times = np.arange(4000.0)
    path = np.c_[np.tile([0.0, 5.0], 2000), np.full(4000, -80.0)]  # 5 m to and fro
    trace = make_trace(times, {"cav0": path})
    town, more = open_town(HOUSE), UNIT | {"pole2": np.array([-100.0, 0.0, 5.0])}
    one = link_vehicles(town, trace, ["cav0"], UNIT, Radio(), seed=7)
    both = link_vehicles(town, trace, ["cav0"], more, Radio(), seed=7)
    np.testing.assert_array_equal(one.loss_db[..., 0], both.loss_db[..., 0])
    assert not np.allclose(link_vehicles(town, trace, ["cav0"], UNIT, Radio(), seed=8).loss_db, one.loss_db)
    extra = (one.loss_db - link_vehicles(town, trace, ["cav0"], UNIT, MEDIAN).loss_db)[:, 0, 0]
    assert extra.std() == pytest.approx(3.0, rel=0.06)
    assert np.corrcoef(extra[:-1], extra[1:])[0, 1] == pytest.approx(np.exp(-5 / 10), abs=0.04)


def test_a_vehicle_that_comes_back_has_shadowing_of_its_own():
    trace = make_trace(np.arange(3.0), {"cav0": [[90.0, 0.0], [np.nan, np.nan], [90.0, 0.0]]})
    loss = link_vehicles(open_town(HOUSE), trace, ["cav0"], UNIT, Radio(), seed=5).loss_db[:, 0, 0]
    draws = stream(5, "shadowing", "cav0", "pole1").standard_normal(3)
    assert loss[2] - loss[0] == pytest.approx(3 * (draws[2] - draws[0]))


def test_a_blocking_vehicle_keeps_its_draw_as_long_as_it_blocks():
    radio = Radio()
    trace = make_trace(np.arange(3.0), {"cav0": [70.0, 0.0], "van1": [80.0, 0.0]}, {"van1": ("truck", 0)})
    links = link_vehicles(open_town(HOUSE), trace, ["cav0"], UNIT, radio, seed=5)
    assert (links.state == PathState.NLOSV).all()
    assert np.ptp(links.loss_db) == pytest.approx(0, abs=1e-9)  # nothing moves: shadowing rests, too
    draw = stream(5, "blockage", "cav0", "pole1", "van1").standard_normal()
    shadow = 3 * stream(5, "shadowing", "cav0", "pole1").standard_normal(3)[0]
    clear = budget.path_loss_db(links.distance_m[0, 0, 0], PathState.NLOSV, 5.9)
    assert links.loss_db[0, 0, 0] == pytest.approx(clear + shadow + max(0, 5 + 4 * draw))


def test_a_highway_knows_no_buildings():
    town = open_town(HOUSE)
    trace = make_trace([0.0], {"cav0": [20.0, 0.0]})
    links = link_vehicles(town, trace, ["cav0"], UNIT, Radio(environment="highway", shadowing=False))
    assert links.state.item() == PathState.LOS
    assert links.loss_db.item() == pytest.approx(32.4 + 20 * np.log10(links.distance_m.item() * 5.9))
    none = open_town()
    assert link_vehicles(none, trace, ["cav0"], UNIT, Radio(environment="highway")).state.item() == PathState.LOS


def test_coverage_is_that_of_links_and_of_the_best_unit():
    town, units = open_town(HOUSE), UNIT | {"pole2": np.array([-60.0, 40.0, 5.0])}
    covered = cover_town(town, units, MEDIAN, step_m=25.0)
    assert covered.rate_bps.shape == covered.state.shape == (len(covered.y), len(covered.x)) == (12, 12)
    vehicle = {"cav0": [[x, y] for y in covered.y for x in covered.x]}
    trace = make_trace(np.arange(144.0), vehicle, {"cav0": ("motorcycle", 0)})  # as high as the standard's antenna
    links = link_vehicles(town, trace, ["cav0"], units, MEDIAN)
    best = links.loss_db[:, 0].argmin(axis=1)
    np.testing.assert_allclose(covered.rate_bps.ravel(), links.rate_bps[np.arange(144), 0, best])
    np.testing.assert_array_equal(covered.state.ravel(), links.state[np.arange(144), 0, best])


def test_bad_input_is_one_sentence():
    town, trace = open_town(HOUSE), make_trace([0.0], {"cav0": [0.0, 0.0]})
    with pytest.raises(InputError, match="square: has no buildings, which the urban model needs"):
        link_vehicles(open_town(), trace, ["cav0"], UNIT, MEDIAN)
    with pytest.raises(InputError, match="pole9: 400, 0, 5 lies outside square"):
        link_vehicles(town, trace, ["cav0"], {"pole9": np.array([400.0, 0.0, 5.0])}, MEDIAN)
    with pytest.raises(InputError, match="pole9: 0, 0, nan lies outside square"):
        cover_town(town, {"pole9": np.array([0.0, 0.0, np.nan])}, MEDIAN)
    with pytest.raises(InputError, match="square: no roadside unit is given"):
        link_vehicles(town, trace, ["cav0"], {}, MEDIAN)
    with pytest.raises(InputError, match="the trace has no vehicle 'cav1'"):
        link_vehicles(town, trace, ["cav1"], UNIT, MEDIAN)
    with pytest.raises(InputError, match="a grid of 0 m"):
        cover_town(town, UNIT, MEDIAN, step_m=0.0)
    with pytest.raises(InputError, match="suburb: has no pole 9; its poles are 1, 2, 3, 4"):
        unit_positions(load_town("suburb"), [1, 9])
