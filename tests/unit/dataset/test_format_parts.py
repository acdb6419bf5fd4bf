"""The parts of the exporters whose truth is elsewhere: beam tables, PCD headers, COCO's masks, poses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pycocotools import mask as coco_mask
from scipy.spatial.transform import Rotation
from toy_source import ToySource

from flcav.cli.main import run
from flcav.dataset.formats.coco import encode_run_lengths, mask_sign
from flcav.dataset.formats.nuscenes.files import (
    CAMERAS,
    RADAR,
    RESOLUTION_M,
    Row,
    attributes,
    encode_lidar,
    encode_radar,
    link_rows,
    map_mask,
    token,
    visibility,
)
from flcav.dataset.formats.opv2v.files import carla_pose, encode_cloud
from flcav.dataset.formats.opv2v.write import agent_numbers
from flcav.dataset.formats.writing import assign_channels, find_front_camera, quaternion
from flcav.dataset.recording.recorder import record
from flcav.geometry import pose
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.lens import BODY_FROM_OPTICAL
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.world.map.town import load_town

angles = st.floats(-3.1, 3.1)


@settings(max_examples=60, deadline=None)
@given(arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_run_lengths_are_coco_s(mask: np.ndarray):
    runs = encode_run_lengths(mask)
    theirs = coco_mask.encode(np.asfortranarray(mask, np.uint8))
    assert runs == {"size": theirs["size"], "counts": str(theirs["counts"], "ascii")}  # pyright: ignore[reportArgumentType, reportCallIssue]


def test_a_sign_s_mask_is_its_pixels_or_its_rectangle_where_others_show_in_it():
    semantic = np.zeros((6, 8), np.uint8)
    semantic[1:3, 2:5] = SEMANTICS["traffic_sign"]
    semantic[1, 2] = SEMANTICS["vegetation"]  # a leaf before a corner
    semantic[1:3, 6] = SEMANTICS["traffic_light"]
    alone = mask_sign(semantic, np.array([2.0, 1.0, 5.0, 3.0]), 5)
    np.testing.assert_array_equal(np.argwhere(alone), [[1, 3], [1, 4], [2, 2], [2, 3], [2, 4]])
    around = mask_sign(semantic, np.array([2.0, 1.0, 7.0, 3.0]), 5)  # the light stands in the rectangle
    assert around.sum() == 10
    assert around[1:3, 2:7].all()


@pytest.mark.parametrize("beams", [{"beams": "hdl64e"}, {"channels": 16, "up_deg": 15.0, "down_deg": -15.0}])
def test_a_ring_is_the_channel_of_its_ray(beams: dict):
    lidar = Lidar(**beams)
    rays = build_ray_pattern(lidar)
    distance = np.random.default_rng(0).uniform(2, 60, len(rays)).astype(np.float32)
    points = np.column_stack((rays * distance[:, None], np.full(len(rays), 0.5))).astype(np.float32)
    elevations = np.arcsin(rays[:: lidar.azimuth_steps, 2].astype(np.float64))[::-1]
    theirs = np.frombuffer(encode_lidar(points, elevations), np.float32).reshape(-1, 5)
    ring = np.repeat(np.arange(lidar.channels)[::-1], lidar.azimuth_steps)
    np.testing.assert_array_equal(theirs[:, 4], ring)
    np.testing.assert_array_equal(theirs[:, :3], np.column_stack((-points[:, 1], points[:, 0], points[:, 2])))
    assert set(theirs[:, 3].tolist()) == {127.5}
    assert not np.frombuffer(encode_lidar(points, np.zeros(0)), np.float32).reshape(-1, 5)[:, 4].any()


def _read_pcd(data: bytes) -> np.ndarray:
    header, _, rest = data.partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in header.decode().splitlines()[1:])
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(fields["TYPE"].split(), fields["SIZE"].split())]
    dtype = np.dtype(list(zip(fields["FIELDS"].split(), kinds)))
    assert dtype == RADAR
    assert len(rest) == dtype.itemsize * int(fields["POINTS"]) + 1
    return np.frombuffer(rest[:-1], dtype)


def test_what_stands_still_has_no_velocity_over_ground():
    rng = np.random.default_rng(1)
    velocity = np.array([12.0, -1.0, 0.5])
    distance, azimuth, elevation = rng.uniform(5, 80, 20), rng.uniform(-1, 1, 20), rng.uniform(-0.2, 0.2, 20)
    direction = Rotation.from_euler("ZY", np.column_stack((azimuth, -elevation))).apply([1.0, 0, 0])
    doppler = -(direction @ velocity)
    doppler[:5] += 4.0  # recede on their own
    echoes = np.column_stack((distance, azimuth, elevation, doppler, rng.uniform(-5, 20, 20))).astype(np.float32)
    read = _read_pcd(encode_radar(echoes, velocity))
    xyz = np.column_stack([read[axis] for axis in "xyz"])
    np.testing.assert_allclose(xyz, distance[:, None] * direction, rtol=1e-4, atol=1e-4)
    own = np.column_stack((read["vx_comp"], read["vy_comp"]))
    np.testing.assert_allclose(own[:5], 4 * direction[:5, :2], atol=1e-3)
    np.testing.assert_allclose(own[5:], 0, atol=1e-3)
    assert (read["dyn_prop"] == [0] * 5 + [1] * 15).all()
    np.testing.assert_allclose(read["rcs"], echoes[:, 4])
    empty = _read_pcd(encode_radar(np.zeros((0, 5), np.float32), velocity))
    assert len(empty) == 1
    assert np.isnan(empty["x"][0])


def test_the_map_mask_is_the_town_s_roads_with_its_lower_left_corner_as_origin():
    town = load_town("suburb")
    mask = map_mask(town)
    assert mask.shape == tuple(np.round(np.subtract(town.bounds[2:], town.bounds[:2])[::-1] / RESOLUTION_M).astype(int))
    for x, y, _ in town.poles.position:  # poles stand on sidewalks
        column, row = (x - town.bounds[0]) / RESOLUTION_M, mask.shape[0] - (y - town.bounds[1]) / RESOLUTION_M
        assert mask[int(row) - 20 : int(row) + 20, int(column) - 20 : int(column) + 20].max() == 255
    for x, y, *_ in town.buildings:
        column, row = (x - town.bounds[0]) / RESOLUTION_M, mask.shape[0] - (y - town.bounds[1]) / RESOLUTION_M
        assert mask[int(row), int(column)] == 0


@settings(max_examples=60, deadline=None)
@given(st.floats(-90, 90), angles, st.floats(-1.5, 1.5), angles)
def test_carla_s_pose_is_the_mirrored_transform(x: float, yaw: float, pitch: float, roll: float):
    """The oracle turns by scipy: in a left-handed frame a positive pitch is nose up, a positive yaw to the right."""
    ours = pose(x, 2.0, 3.0, yaw, pitch, roll)
    px, py, pz, droll, dyaw, dpitch = carla_pose(ours)
    assert (px, py, pz) == (x, -2.0, 3.0)
    back = Rotation.from_euler("ZYX", [-dyaw, -dpitch, droll], degrees=True).as_matrix()
    np.testing.assert_allclose(back, ours[:3, :3], atol=1e-9)


def test_carla_s_angles_have_the_signs_people_know():
    *_, roll, yaw, pitch = carla_pose(pose(0, 0, 0, yaw=np.radians(30)))
    assert (roll, pitch) == (0, 0)
    assert yaw == pytest.approx(-30)  # to the left
    *_, pitch = carla_pose(pose(0, 0, 0, pitch=np.radians(10)))
    assert pitch == pytest.approx(-10)  # nose down


def test_a_pcd_s_red_is_the_intensity():
    points = np.array([[1.0, 2, 3, 0.0], [4, -5, 6, 1.0], [0, 0, 0, 0.5]], np.float32)
    header, _, data = encode_cloud(points).partition(b"DATA binary\n")
    assert b"WIDTH 3\nHEIGHT 1\n" in header
    rows = np.frombuffer(data, "<f4").reshape(3, 4)
    np.testing.assert_array_equal(rows[:, :3], points[:, :3] * (1, -1, 1))
    blue_green_red = rows[:, 3].copy().view(np.uint8).reshape(3, 4)
    assert blue_green_red.tolist() == [[0, 0, 0, 0], [0, 0, 255, 0], [0, 0, 128, 0]]


def test_vehicles_are_numbered_before_poles():
    numbers = agent_numbers(["cav0", "cav11", "pole1", "pole9"])
    assert sorted(numbers, key=lambda agent: str(numbers[agent])) == ["cav0", "cav11", "pole1", "pole9"]
    assert len({len(str(number)) for number in numbers.values()}) == 1


def _camera(yaw_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    return pose(0, 0, 0, np.radians(yaw_deg), np.radians(pitch_deg)) @ BODY_FROM_OPTICAL


def test_the_front_camera_is_level_and_looks_ahead():
    assert find_front_camera({"left": _camera(25), "ahead": _camera(-4), "back": _camera(180)}) == "ahead"
    assert find_front_camera({"down": _camera(0, 10), "left": _camera(20)}) == "left"
    assert find_front_camera({"side": _camera(90), "down": _camera(0, 10)}) is None
    assert find_front_camera({}) is None


def test_channels_go_to_the_sensors_that_look_their_way():
    six = {name: direction + 0.1 for name, direction in CAMERAS.items()}
    assert assign_channels(six, CAMERAS) == {name: name for name in CAMERAS}
    assert assign_channels({"a": 0.05, "b": 3.1}, CAMERAS) == {"a": "CAM_FRONT", "b": "CAM_BACK"}
    assert assign_channels({"a": 0.0, "b": 0.1}, CAMERAS) == {"a": "CAM_FRONT", "b": "CAM_FRONT_LEFT"}
    seven = assign_channels({f"c{i}": i for i in range(7)}, CAMERAS)
    assert len(seven) == 6
    assert assign_channels({}, CAMERAS) == {}


@settings(max_examples=30, deadline=None)
@given(angles, st.floats(-1.5, 1.5), angles)
def test_quaternions_turn_as_the_matrix_does(yaw: float, pitch: float, roll: float):
    w, *xyz = quaternion(pose(1, 2, 3, yaw, pitch, roll))
    vector, axis = np.array([0.3, -0.4, 0.9]), np.array(xyz)
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    np.testing.assert_allclose(turned, pose(0, 0, 0, yaw, pitch, roll)[:3, :3] @ vector, atol=1e-9)
    assert w >= 0


def test_nuscenes_levels_and_attributes():
    assert [visibility(occlusion) for occlusion in (1.0, 0.61, 0.59, 0.39, 0.19, 0.0)] == ["1", "1", "2", "3", "4", "4"]
    names = {
        ("car", "parked3", 0.0): "vehicle.parked",
        ("bus", "veh1", 0.0): "vehicle.stopped",
        ("car", "veh1", 3.0): "vehicle.moving",
        ("pedestrian", "ped1", 1.0): "pedestrian.moving",
        ("pedestrian", "ped1", 0.0): "pedestrian.standing",
        ("bicycle", "veh2", 3.0): "cycle.with_rider",
    }
    for (category, track, speed), name in names.items():
        assert attributes(category, track, speed) == [token("attribute", name)]
    rows: list[Row] = [{"token": name} for name in "abc"]
    link_rows(rows)
    assert [(row["prev"], row["next"]) for row in rows] == [("", "b"), ("a", "c"), ("b", "")]


def test_the_command_line_exports(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    record(ToySource(), tmp_path / "data")

    def flcav(*arguments: str) -> int:
        with pytest.raises(SystemExit) as end:
            run(["export", *arguments, str(tmp_path / "data")])
        return int(end.value.code or 0)

    out = str(tmp_path / "out")
    assert flcav("--out", out, "opv2v") == 0
    assert "exported 2 scenarios, 12 frames" in capsys.readouterr().out
    assert flcav("--out", out, "opv2v") == 2
    assert "holds other files" in capsys.readouterr().err
    assert flcav("--out", str(tmp_path / "b"), "kitty") == 2
    assert "export format 'kitty': choose one of kitti, yolo" in capsys.readouterr().err
    assert flcav("--out", str(tmp_path / "b"), "--labels", "cats", "yolo") == 2
    assert "'labels' = 'cats'" in capsys.readouterr().err
    assert flcav("--out", str(tmp_path / "b"), "--labels", "actors", "kitti") == 2
    assert "format 'kitti': has no use for --labels; it takes --validation" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
