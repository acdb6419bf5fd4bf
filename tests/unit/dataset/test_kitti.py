import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.dataset.formats.kitti import Calibration, read_calibration, read_labels, read_points
from flcav.geometry import points_in_boxes

CALIBRATION = """P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3
"""
REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "kitti_frame"


@pytest.fixture
def calibration(tmp_path: Path) -> Calibration:
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return read_calibration(tmp_path / "calib.txt")


def test_points_are_as_written(tmp_path: Path):
    points = np.arange(12, dtype=np.float32).reshape(3, 4)
    points.tofile(tmp_path / "a.bin")
    read = read_points(tmp_path / "a.bin")
    np.testing.assert_array_equal(read, points)
    assert read.dtype == np.float32
    assert read.flags.writeable


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty"),
        (b"\0" * 17, "truncated; 17 bytes"),
        (np.array([[0, 0, 0, 0], [0, np.nan, 0, 0]], np.float32).tobytes(), "point 1 is not finite"),
    ],
)
def test_what_is_no_point_cloud(tmp_path: Path, data: bytes, message: str):
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.bin: {message}"):
        read_points(tmp_path / "a.bin")


def test_a_missing_point_cloud(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path / "a.bin")
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path)


def test_calibration_maps_camera_axes_to_lidar_axes(calibration: Calibration):
    ahead_in_camera = calibration.camera_from_lidar @ [10.0, 2.0, -1.0, 1.0]
    np.testing.assert_allclose(ahead_in_camera[:3], [-2.0 + 0.1, 1.0 - 0.2, 10.0 - 0.3])


@pytest.mark.parametrize("text", ["", CALIBRATION.replace("0.1 ", ""), CALIBRATION.replace("R0_rect", "R9"), "P2: x"])
def test_what_is_no_calibration(tmp_path: Path, text: str):
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(InputError, match=r"calib\.txt: needs \d+ numbers after"):
        read_calibration(tmp_path / "calib.txt")


@settings(max_examples=50, deadline=None)
@given(
    x=st.floats(-20, 20),
    y=st.floats(-1, 3),
    z=st.floats(4, 60),
    rotation=st.floats(-np.pi, np.pi),
    length=st.floats(0.5, 6),
)
def test_boxes_match_the_devkit_corners(
    tmp_path_factory: pytest.TempPathFactory, x: float, y: float, z: float, rotation: float, length: float
):
    """The oracle is the devkit's computeBox3D: corners about the bottom centre, turned about the camera's y axis."""
    height, width = 1.5, 1.7
    camera_from_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]], float)
    line = f"Car 0 0 0 0 0 0 0 {height} {width} {length!r} {x!r} {y!r} {z!r} {rotation!r}\n"
    cos, sin = np.cos(rotation), np.sin(rotation)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    corners = np.array([[i * length / 2, j * height, k * width / 2] for i in (1, -1) for j in (0, -1) for k in (1, -1)])
    camera = corners @ turn.T + (x, y, z)
    lidar = np.linalg.solve(camera_from_lidar, np.column_stack((camera, np.ones(8))).T).T[:, :3]
    path = tmp_path_factory.getbasetemp() / "label.txt"
    path.write_text(line)
    box = read_labels(path, Calibration(camera_from_lidar, np.zeros((3, 4))))
    distance = np.linalg.norm(box.corners()[0][:, None] - lidar[None], axis=2)
    assert distance.min(axis=1).max() < 1e-9
    front = lidar[:4].mean(axis=0) - lidar.mean(axis=0)
    heading = [np.cos(box.yaw[0]), np.sin(box.yaw[0]), 0.0]
    np.testing.assert_allclose(front / np.linalg.norm(front), heading, atol=1e-9)


def test_dont_care_is_left_out_and_scores_kept(tmp_path: Path, calibration: Calibration):
    path = tmp_path / "label.txt"
    row = "0 0 0 0 0 0 0 1.5 1.7 4 1 2 20 0.5"
    path.write_text(f"Van {row} 0.75\nDontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n")
    boxes = read_labels(path, calibration)
    assert boxes.label.tolist() == ["Van"]
    assert boxes.score is not None
    assert boxes.score.tolist() == [0.75]
    path.write_text(f"Van {row}\n")
    assert read_labels(path, calibration).score is None
    path.write_text("")
    assert len(read_labels(path, calibration)) == 0


@pytest.mark.parametrize("text", ["Car 1 2 3", "Car " + "x " * 14, "Car " + "nan " * 14, "1 " * 30])
def test_what_is_no_label(tmp_path: Path, calibration: Calibration, text: str):
    (tmp_path / "label.txt").write_text(text)
    with pytest.raises(InputError, match=r"label\.txt: line 1 is no KITTI label"):
        read_labels(tmp_path / "label.txt", calibration)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real KITTI frame is not at {REAL}; set FLCAV_REAL_DATA")
def test_the_boxes_of_the_real_frame_hold_its_points():
    frame = REAL / "training"
    points = read_points(frame / "velodyne" / "000008.bin")
    boxes = read_labels(frame / "label_2" / "000008.txt", read_calibration(frame / "calib" / "000008.txt"))
    assert points.shape == (17238, 4)
    assert boxes.label.tolist() == ["Car"] * 6
    inside = points_in_boxes(points, boxes).sum(axis=1)
    distance = np.linalg.norm(boxes.center, axis=1)
    assert (inside > 50).all(), inside
    assert inside[distance < 9].min() > 500, inside
    bottom = boxes.center[:, 2] - boxes.size[:, 2] / 2
    assert ((bottom > -2.2) & (bottom < -1.3)).all(), bottom
