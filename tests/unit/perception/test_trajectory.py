"""The trajectory task against motion known in closed form, matrices, polygons and loops."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon

from flcav.config import InputError
from flcav.dataset.layout import FrameKey
from flcav.geometry import inverse, pose
from flcav.perception.task import build_network, find_configuration
from flcav.perception.trajectory.config import FUTURE, PAST, STEP_S, CrossView, Patch, TrajectoryConfig
from flcav.perception.trajectory.evaluate import compute_errors, evaluate_paths, is_turning
from flcav.perception.trajectory.model import (
    FAR_M,
    LEARNED,
    SCALE_M,
    CrossAttention,
    CrossViewEncoder,
    ForecastInputs,
    ForecastTensors,
    cast_rays,
    intersect_ground,
    pixel_grid,
    place_grid,
)
from flcav.perception.trajectory.rasters import BEFORE_M, LAYERS, STATIC, cell_of, centres, road_map
from flcav.perception.trajectory.samples import extract_columns, rescaled
from flcav.perception.trajectory.task import TRAJECTORY, forecast_loss, map_loss
from flcav.perception.trajectory.tracks import (
    check_instants,
    constant_velocity,
    into_frame,
    out_of_frame,
    tracks_around,
    tracks_at,
)
from flcav.world.map.lanes import RASTER_LAYERS, map_layers, rasterise
from flcav.world.map.town import load_town
from flcav.world.trace import Trace

RADIUS_M, SPEED = 20.0, 8.0
PATCH = Patch()
KEY = FrameKey("scene", 0, "cav0", 5.0)


@pytest.fixture(scope="module")
def town():
    return load_town("grid")


@pytest.fixture(scope="module")
def roads(town):
    return road_map(town)


def trace_of(time_s, position, yaw, velocity, **changes) -> Trace:
    """Return cars (T, A) without lights."""
    instants, actors = yaw.shape
    fields = {
        "town": "grid",
        "time_s": time_s,
        "actor": np.array([f"veh{i}" for i in range(actors)]),
        "category": np.full(actors, "car"),
        "shape": np.zeros(actors, np.int64),
        "size": np.tile((4.4, 1.8, 1.6), (actors, 1)),
        "present": np.isfinite(yaw),
        "position": np.concatenate((position, np.zeros((instants, actors, 1))), axis=2),
        "yaw": yaw,
        "velocity": np.concatenate((velocity, np.zeros((instants, actors, 1))), axis=2),
        "acceleration": np.zeros((instants, actors, 3)),
        "yaw_rate": np.zeros((instants, actors)),
        "light": np.zeros(0, np.str_),
        "light_state": np.zeros((instants, 0), "<U1"),
    }
    return Trace(**{**fields, **changes})


def on_a_circle(time_s) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    angle = np.asarray(time_s)[:, None] * SPEED / RADIUS_M
    position = RADIUS_M * np.stack((np.cos(angle), np.sin(angle)), axis=2)
    velocity = SPEED * np.stack((-np.sin(angle), np.cos(angle)), axis=2)
    return position, (angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi, velocity


def circle() -> Trace:
    time_s = np.arange(0, 10.1, 0.5)
    return trace_of(time_s, *on_a_circle(time_s), yaw_rate=np.full((len(time_s), 1), SPEED / RADIUS_M))


def columns_at(trace: Trace, roads, wanted, **options):
    """Return the samples at the time of `KEY`."""
    return extract_columns(trace, tracks_around(trace, KEY.time_s), KEY, 0, roads, PATCH, np.array(wanted), **options)


def test_tracks_between_instants_follow_the_motion():
    times = np.arange(1.0, 9.0, 0.25)
    found, (position, yaw, _) = tracks_at(circle(), times), on_a_circle(times)
    assert np.abs(found.position - position).max() < 0.01  # half a metre would be the chord's sagitta at 4 m
    assert np.abs(np.angle(np.exp(1j * (found.yaw - yaw)))).max() < 1e-6
    assert np.allclose(found.speed, SPEED)


def test_nobody_is_where_the_trace_does_not_have_him():
    trace = circle()
    gone = trace.present.copy()
    gone[10] = False
    found = tracks_at(replace(trace, present=gone), np.array([-0.25, 4.5, 4.75, 5.25, 5.5, 10.25]))
    assert np.isfinite(found.yaw[:, 0]).tolist() == [False, True, False, False, True, False]


def test_spins_far_apart_are_refused():
    trace = circle()
    check_instants(trace, "data")
    with pytest.raises(InputError, match="data: spins up to 1 s apart"):
        check_instants(replace(trace, time_s=trace.time_s * 2), "data")


@given(st.tuples(*[st.floats(-50, 50)] * 2, st.floats(-4, 4)), st.tuples(*[st.floats(-50, 50)] * 2))
def test_frames_are_those_of_the_matrices(at, point):
    local = into_frame(np.array([[point]]), np.array([at]))
    expected = inverse(pose(at[0], at[1], yaw=at[2])) @ (*point, 0, 1)
    assert np.allclose(local[0, 0], expected[:2], atol=1e-9)
    assert np.allclose(out_of_frame(local, np.array([at]))[0, 0], point, atol=1e-9)


def test_a_sample_of_the_circle(roads):
    rows = columns_at(circle(), roads, [True])
    turn = SPEED / RADIUS_M * STEP_S * np.arange(-PAST, FUTURE + 1)
    path = RADIUS_M * np.stack((np.sin(turn), 1 - np.cos(turn)), axis=1)
    assert np.allclose(rows.past[0, :, :2], path[: PAST + 1], atol=0.06)  # one-sided tangents where instants end
    assert np.allclose(rows.future[0], path[PAST + 1 :], atol=0.01)
    assert np.allclose(rows.past[0, :, 2], turn[: PAST + 1], atol=1e-6)
    plain = constant_velocity(rows.past)
    assert np.allclose(plain[0, -1], (3 * SPEED, 0), atol=1e-5)
    bits = np.unpackbits(rows.raster, axis=-1)[0]
    own = bits[LAYERS.index("self")]
    assert 6 <= own.sum() <= 15  # 4.4 m x 1.8 m
    at, _ = cell_of(np.zeros(2), PATCH)
    assert own.reshape(-1)[at]


def test_others_are_marked_where_they_are(roads):
    trace = circle()
    both = trace_of(
        trace.time_s,
        np.concatenate((trace.position[..., :2], trace.position[..., :2] * 1.5), axis=1),
        np.repeat(trace.yaw, 2, axis=1),
        np.concatenate((trace.velocity[..., :2], trace.velocity[..., :2] * 1.5), axis=1),
        yaw_rate=np.repeat(trace.yaw_rate, 2, axis=1),
    )
    rows = columns_at(both, roads, [True, False])
    bits = np.unpackbits(rows.raster, axis=-1)[0].astype(bool)
    middle = centres(PATCH)[bits[LAYERS.index("others 0 s ago")].reshape(-1)].mean(axis=0)
    assert np.allclose(middle, (0, -RADIUS_M / 2), atol=0.7)  # outside on the same ray: to the right
    assert not bits[LAYERS.index("pedestrian")].any()


def test_cells_are_those_of_their_middles():
    cell, inside = cell_of(centres(PATCH), PATCH)
    assert inside.all()
    assert np.array_equal(cell, np.arange(PATCH.cells**2))
    assert not cell_of(np.array([PATCH.side_m, 0.0]), PATCH)[1]


def test_the_map_around_is_that_of_the_scan_lines(town, roads):
    at = np.array([[0.0, 0.0, 0.7]])
    found = roads.static(out_of_frame(centres(PATCH)[None], at)[0]).T.reshape(len(STATIC), PATCH.cells, PATCH.cells)
    middle = pose(0, 0, yaw=0.7) @ pose(PATCH.middle_x_m, 0)
    exact = rasterise(map_layers(town), middle, (PATCH.side_m, PATCH.side_m), PATCH.cell_m)
    for layer, seen in zip(STATIC, found, strict=True):
        wanted = exact[RASTER_LAYERS.index(layer)]
        assert wanted.any()
        assert (seen == wanted).mean() > 0.97  # edges are half a metre coarse


def test_who_is_at_a_junction(town, roads):
    layers = map_layers(town)
    lane = next(lane for lane in layers.lanes if lane.id == "x01_x11_4")
    line = LineString(lane.centre_line)
    before = np.array([5.0, 15.0, 25.0, 35.0])
    points = shapely.get_coordinates(shapely.line_interpolate_point(line, line.length - before))
    ahead = lane.centre_line[-1] - lane.centre_line[-2]
    yaw = np.full(4, np.arctan2(ahead[1], ahead[0]))
    lanes, distance = roads.lanes_at(points, yaw)
    assert np.allclose(distance, before, atol=0.7)
    assert (distance <= BEFORE_M).tolist() == [True, True, False, False]
    assert all(len(found) == 1 for found in lanes)
    assert not np.isfinite(roads.lanes_at(points, yaw + np.pi)[1]).any()  # nobody drives there the other way
    inside = next(row for row in layers.lanes if row.id == ":x11_18_1")
    reached = roads.reach[lanes[0][0]]
    ways = Polygon(LineString(inside.centre_line).buffer(0.5).exterior)
    assert shapely.contains_xy(ways, reached[:, 0], reached[:, 1]).any()


def test_errors_by_hand():
    random = np.random.default_rng(3)
    paths, future = random.normal(size=(5, 4, FUTURE, 2)), random.normal(size=(5, FUTURE, 2))
    shares, plain = random.random((5, 4)), random.normal(size=(5, FUTURE, 2))
    errors = compute_errors(paths, shares, future, plain)
    for i in range(5):
        off = [[np.hypot(*(paths[i, k, t] - future[i, t])) for t in range(FUTURE)] for k in range(4)]
        expected = [
            sum(shares[i, j] * np.hypot(*(paths[i, k] - paths[i, j]).T).mean() for j in range(4)) for k in range(4)
        ]
        for name, first in (("min%s_1", off[int(np.argmax(shares[i]))]), ("single_%s", off[int(np.argmin(expected))])):
            assert np.isclose(errors[name % "ADE"][i], np.mean(first))
            assert np.isclose(errors[name % "FDE"][i], first[-1])
        assert np.isclose(errors["minADE_K"][i], min(np.mean(row) for row in off))
        assert np.isclose(errors["minFDE_K"][i], min(row[-1] for row in off))
        assert np.isclose(errors["constant_velocity_FDE"][i], np.hypot(*(plain[i, -1] - future[i, -1])))


def test_slices_and_misses():
    ahead = np.zeros((3, FUTURE, 2))
    ahead[..., 0] = np.arange(1, FUTURE + 1) * 2.0
    turned = ahead.copy()
    turned[2] = np.stack((np.minimum(ahead[2, :, 0], 6), np.maximum(ahead[2, :, 0] - 6, 0)), axis=1)
    assert is_turning(turned).tolist() == [False, False, True]
    past = np.zeros((3, PAST + 1, 4))
    past[..., 3] = 8.0
    at_junction, scene = np.array([False, True, True]), np.array(["a"] * 3)
    result = evaluate_paths(ahead[:, None], np.ones((3, 1)), past, turned, at_junction, scene)
    every, junctions, turned_there = result.slices.values()
    assert every is not None
    assert junctions is not None
    assert turned_there is not None
    assert (every.samples, junctions.samples, turned_there.samples) == (3, 2, 1)
    assert every.miss_rate_1 == pytest.approx(1 / 3)
    assert turned_there.ratio_1 == pytest.approx(1.0)
    nobody = evaluate_paths(ahead[:1, None], np.ones((1, 1)), past[:1], turned[:1], at_junction[:1], scene[:1])
    assert nobody.slices["at junctions"] is None


def test_only_the_nearest_mode_learns_much():
    future = torch.zeros(1, FUTURE, 2)
    paths = torch.zeros(1, 3, FUTURE, 2)
    paths[0, :, :, 0] = torch.tensor([5.0, 0.3, -8.0])[:, None]
    paths.requires_grad_()
    logits = torch.zeros(1, 3, requires_grad=True)
    forecast_loss(ForecastTensors(paths, logits, None), future).backward()
    assert paths.grad is not None
    assert logits.grad is not None
    pull = paths.grad.abs().sum(dim=(0, 2, 3))
    assert pull.argmax() == 1
    assert (pull > 0).all()  # none is lost
    assert logits.grad[0].argmin() == 1  # its probability rises


def test_a_map_is_judged_by_its_own_layers():
    raster = torch.zeros(1, len(LAYERS), 64, 64)
    raster[:, LAYERS.index("road"), :32] = 1
    right = torch.full((1, len(LEARNED), 32, 32), -9.0)
    right[:, 0, :16] = 9.0
    assert map_loss(right, raster) < 0.01 < map_loss(right.flip(2), raster)


def test_paths_begin_as_constant_velocity_and_look_where_they_are():
    network = build_network(TRAJECTORY, find_configuration(TRAJECTORY, None), 1).eval()
    past = torch.zeros(2, PAST + 1, 4)
    past[:, :, 3] = torch.tensor([6.0, 0.0])[:, None]
    forecast = network(ForecastInputs(past, raster=torch.zeros(2, len(LAYERS), 64, 64)))
    plain = torch.from_numpy(constant_velocity(past.numpy())).float()
    assert forecast.paths.shape == (2, 6, FUTURE, 2)
    assert (forecast.paths - plain[:, None]).abs().max() < 2.0
    middles = centres(Patch(cells=16, cell_m=4.0)).reshape(16, 16, 2)
    ground = torch.from_numpy(np.ascontiguousarray(middles)).float().permute(2, 0, 1)[None]
    asked = torch.tensor([[[0.0, 0.0], [30.0, -12.0], [5.0, 20.0]]])
    assert torch.allclose(network._ground_at(ground, asked), asked, atol=1e-4)


def test_rays_meet_the_ground_where_it_projects_from():
    settings = CrossView(width_px=128, height_px=64)
    intrinsics = np.array([[60.0, 0, 63.5], [0, 60.0, 31.5], [0, 0, 1]])
    optical = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    frame_from_camera = pose(1.0, 0.5, 1.5, 0.6, 0.2) @ optical
    camera_from_frame = inverse(frame_from_camera)
    given = [torch.from_numpy(matrix)[None, None] for matrix in (intrinsics, camera_from_frame)]
    looks, stands = cast_rays(given[0], given[1], pixel_grid(settings).double())
    assert np.allclose(stands[0, 0] * SCALE_M, (1.0, 0.5, 1.5))
    down = looks[0, 0, :, 2] < -0.05
    met = SCALE_M * intersect_ground(looks, stands)[0, 0]
    ground = torch.cat((met[down], torch.zeros(int(down.sum()), 1), torch.ones(int(down.sum()), 1)), dim=1)
    seen = ground.numpy() @ camera_from_frame.T
    pixel = seen[:, :3] @ intrinsics.T
    assert np.allclose(pixel[:, :2] / pixel[:, 2:], pixel_grid(settings)[down, :2], atol=1e-4)
    up = looks[0, 0, :, 2] >= 0
    assert 0 < up.sum() < len(up) - down.sum()
    assert torch.allclose((met[up] - met.new_tensor((1.0, 0.5))).norm(dim=1), met.new_tensor(FAR_M))
    assert len(place_grid(settings, PATCH)) == settings.queries**2


def test_the_ground_attends_by_cosine_and_nearness():
    random = torch.Generator().manual_seed(2)
    attend = CrossAttention(width=16, heads=2).double()
    ground, places = (torch.randn(shape, generator=random).double() for shape in ((1, 3, 16), (3, 2)))
    seen, met = (torch.randn(shape, generator=random).double() for shape in ((1, 5, 16), (1, 5, 2)))
    found = []
    query, key, value = (
        part[0].unflatten(-1, (2, -1)) for part in (attend.query(ground), attend.key(seen), attend.value(seen))
    )
    for q in range(3):
        for head in range(2):
            cosine = torch.cosine_similarity(query[q, head][None], key[:, head], dim=1)
            apart = (places[q] - met[0]).square().sum(dim=1)
            share = (attend.sharpness[head, 0] * cosine - attend.nearness[head, 0] * apart).softmax(dim=0)
            found.append(share @ value[:, head])
    after = ground + attend.out(torch.cat(found).reshape(1, 3, 16))
    assert torch.allclose(attend(ground, places, seen, met), after + attend.after(after))


def test_resized_pictures_keep_their_rays():
    rgb, settings = np.zeros((128, 256, 3), np.uint8), CrossView(width_px=128, height_px=64)
    small = rescaled(np.array([[100.0, 0, 127.5], [0, 100.0, 63.5], [0, 0, 1]]), rgb, settings)
    assert np.allclose(small, [[50.0, 0, 63.5], [0, 50.0, 31.5], [0, 0, 1]])


def test_cameras_are_learned_through_end_to_end():
    network = build_network(TRAJECTORY, TrajectoryConfig(cameras=CrossView(width_px=128, height_px=64)), 1)
    random = torch.Generator().manual_seed(0)
    pictures = torch.rand(2, 6, 3, 64, 128, generator=random)
    intrinsics = torch.tensor([[60.0, 0, 63.5], [0, 60.0, 31.5], [0, 0, 1]]).expand(2, 6, 3, 3)
    views = torch.eye(4).expand(2, 6, 4, 4)
    forecast = network(ForecastInputs(torch.zeros(2, PAST + 1, 4), None, pictures, intrinsics, views))
    assert forecast.map_logits is not None
    assert forecast.map_logits.shape == (2, len(LEARNED), 32, 32)
    forecast_loss(forecast, torch.ones(2, FUTURE, 2)).backward()
    assert isinstance(network.view, CrossViewEncoder)
    first = next(network.view.pictures.parameters())
    assert first.grad is not None
    assert first.grad.abs().sum() > 0
