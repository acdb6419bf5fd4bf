import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.kitti import (
    KittiCalibration,
    KittiFolder,
    read_calibration,
    read_objects,
    read_points,
)
from flcav.dataset.formats.kitti.files import Objects, assume_size
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.geometry import inverse, points_in_boxes, transform_points

CALIBRATION = """P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3
"""
REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "kitti_frame"


@pytest.fixture
def calibration(tmp_path: Path) -> KittiCalibration:
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return read_calibration(tmp_path / "calib.txt")


def test_points_are_as_written(tmp_path: Path):
    points = np.arange(12, dtype=np.float32).reshape(3, 4) * (1, 1, 1, 0.05)
    points = points.astype(np.float32)
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
        (b"Car 0.00 0 -1.6001\n", "a text file; wanted are 4 columns of float32"),
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
    with pytest.raises(InputError, match="is a folder, and a file is wanted"):
        read_points(tmp_path)


def test_calibration_maps_camera_axes_to_lidar_axes(calibration: KittiCalibration):
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
    box = read_objects(path, KittiCalibration(camera_from_lidar, np.zeros((3, 4)))).boxes
    distance = np.linalg.norm(box.corners()[0][:, None] - lidar[None], axis=2)
    assert distance.min(axis=1).max() < 1e-9
    front = lidar[:4].mean(axis=0) - lidar.mean(axis=0)
    heading = [np.cos(box.yaw[0]), np.sin(box.yaw[0]), 0.0]
    np.testing.assert_allclose(front / np.linalg.norm(front), heading, atol=1e-9)


def test_dont_care_is_left_out_and_scores_kept(tmp_path: Path, calibration: KittiCalibration):
    path = tmp_path / "label.txt"
    row = "0 0 0 0 0 0 0 1.5 1.7 4 1 2 20 0.5"
    path.write_text(f"Van {row} 0.75\nDontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n")
    boxes = read_objects(path, calibration).boxes
    assert boxes.label.tolist() == ["Van"]
    assert boxes.score is not None
    assert boxes.score.tolist() == [0.75]
    path.write_text(f"Van {row}\n")
    assert read_objects(path, calibration).boxes.score is None
    path.write_text("")
    assert len(read_objects(path, calibration).boxes) == 0


@pytest.mark.parametrize("text", ["Car 1 2 3", "Car " + "x " * 14, "Car " + "nan " * 14, "1 " * 30])
def test_what_is_no_label(tmp_path: Path, calibration: KittiCalibration, text: str):
    (tmp_path / "label.txt").write_text(text)
    with pytest.raises(InputError, match=r"label\.txt: line 1 is no KITTI label"):
        read_objects(tmp_path / "label.txt", calibration)


LABEL = "Car 0.10 1 -0.5 10 20 50 60 1.5 1.7 4 1 2 20 0.5\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames in KITTI's layout, the second of them in the list `val`."""
    root = tmp_path / "kitti"
    for part in ("calib", "velodyne", "image_2", "label_2"):
        (root / "training" / part).mkdir(parents=True)
    for name in ("000000", "000001"):
        (root / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION)
        np.ones((3, 4), np.float32).tofile(root / "training" / "velodyne" / f"{name}.bin")
        Image.new("RGB", (100, 80), (1, 2, 3)).save(root / "training" / "image_2" / f"{name}.png")
        (root / "training" / "label_2" / f"{name}.txt").write_text(LABEL)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("000001\n")
    return root


def test_a_folder_is_read_frame_by_frame(folder: Path):
    assert KittiFolder.open(folder).names == ["000000", "000001"]
    kitti = KittiFolder.open(folder, "val")
    assert len(kitti) == 1
    frame = kitti.frame(0)
    assert (frame.name, frame.points.shape, frame.image.shape) == ("000001", (3, 4), (80, 100, 3))
    assert frame.image[0, 0].tolist() == [1, 2, 3]
    objects = frame.objects
    assert (objects.truncation[0], objects.occlusion[0], objects.alpha[0]) == (0.1, 1, -0.5)
    assert objects.rectangle.tolist() == [[10, 20, 50, 60]]


def _replace(part: str, old: str, new: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        path = root / part
        path.write_text(path.read_text().replace(old, new))

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: shutil.rmtree(root / "training"), "no KITTI folder; it holds no 'training'"),
        (lambda root: (root / "training" / "calib" / "000001.txt").unlink(), r"calib/000001\.txt: missing"),
        (lambda root: (root / "ImageSets" / "val.txt").unlink(), r"val\.txt: no such list"),
        (_replace("ImageSets/val.txt", "000001", "000001\n000001"), "names the frame 000001 twice"),
        (_replace("ImageSets/val.txt", "000001", "000007"), r"calib/000007\.txt: missing"),
        (_replace("training/label_2/000001.txt", "Car", "Lorry"), "unknown class 'Lorry'; KITTI has Car"),
        (_replace("training/label_2/000001.txt", " 50 60", " 150 60"), "object 1 has a rectangle .* of 100 x 80"),
        (_replace("training/label_2/000001.txt", " 10 20", " 51 20"), "object 1 has a rectangle"),
        (_replace("training/label_2/000001.txt", "0.10", "1.10"), "object 1 has a truncation outside 0 to 1"),
        (_replace("training/label_2/000001.txt", "0.10 1 ", "0.10 4 "), "object 1 has an occlusion"),
        (_replace("training/label_2/000001.txt", "1.7", "0.0"), "object 1 has a size that is not positive"),
        (lambda root: (root / "training" / "image_2" / "000001.png").write_text("no"), r"000001\.png: not an image"),
    ],
)
def test_what_is_wrong_in_a_folder_is_one_sentence(folder: Path, damage: Callable[[Path], None], message: str):
    damage(folder)
    with pytest.raises(InputError, match=message):
        KittiFolder.open(folder, "val").frame(0)


def test_regions_nobody_cares_about_are_in_no_column(tmp_path: Path, calibration: KittiCalibration):
    (tmp_path / "label.txt").write_text(LABEL + LABEL.replace("Car", "DontCare"))
    objects = read_objects(tmp_path / "label.txt", calibration)
    assert objects.boxes.label.tolist() == ["Car"]
    assert [len(part) for part in (objects.truncation, objects.occlusion, objects.alpha, objects.rectangle)] == [1] * 4


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real KITTI frame is not at {REAL}; set FLCAV_REAL_DATA")
def test_the_boxes_of_the_real_frame_hold_its_points():
    frame = REAL / "training"
    points = read_points(frame / "velodyne" / "000008.bin")
    calibration = read_calibration(frame / "calib" / "000008.txt")
    boxes = read_objects(frame / "label_2" / "000008.txt", calibration).boxes
    assert points.shape == (17238, 4)
    assert boxes.label.tolist() == ["Car"] * 6
    inside = points_in_boxes(points, boxes).sum(axis=1)
    distance = np.linalg.norm(boxes.center, axis=1)
    assert (inside > 50).all(), inside
    assert inside[distance < 9].min() > 500, inside
    bottom = boxes.center[:, 2] - boxes.size[:, 2] / 2
    assert ((bottom > -2.2) & (bottom < -1.3)).all(), bottom


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real KITTI frame is not at {REAL}; set FLCAV_REAL_DATA")
def test_the_real_frame_is_a_whole_folder_and_its_points_project_onto_their_objects():
    kitti = KittiFolder.open(REAL)
    assert kitti.names == ["000008"]
    frame = kitti.frame(0)
    assert frame.image.shape == (375, 1242, 3)
    inside = points_in_boxes(frame.points, frame.objects.boxes)
    for points, (left, top, right, bottom) in zip(inside, frame.objects.rectangle):
        lidar = np.column_stack((frame.points[points, :3], np.ones(points.sum())))
        projected = lidar @ (frame.calibration.image_from_camera @ frame.calibration.camera_from_lidar).T
        u, v = projected[:, 0] / projected[:, 2], projected[:, 1] / projected[:, 2]
        within = (u > left - 5) & (u < right + 5) & (v > top - 5) & (v < bottom + 5)
        assert within.mean() > 0.95


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real KITTI frame is not at {REAL}; set FLCAV_REAL_DATA")
def test_the_real_frame_is_imported_with_its_boxes_in_the_picture(tmp_path: Path):
    import_dataset("kitti", REAL, tmp_path / "out")
    assert validate(tmp_path / "out") == []
    data = Dataset.open(tmp_path / "out")
    frame = data.frame(0)
    truth = frame.annotations
    assert truth.boxes.label.tolist() == ["car"] * 6
    assert (truth.returns > 20).all()
    assert (data.folder / "velodyne" / f"{frame.key}.bin").resolve().name == "000008.bin"
    center = transform_points(inverse(frame.world_from_sensor("image_2")), truth.boxes.center)
    pixels = center @ frame.calibration.intrinsics["image_2"].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    rectangle = truth.views["image_2"].amodal_box
    whole = truth.views["image_2"].truncation == 0
    assert whole.sum() == 4
    assert ((pixels > rectangle[:, :2]) & (pixels < rectangle[:, 2:]))[whole].all()
    assert np.isnan(truth.velocity).all()
    assert np.isnan(truth.views["image_2"].occlusion).tolist() == [True, False, True, False, False, False]


def test_a_missing_image_is_as_large_as_the_camera_s_calibration_and_labels_say():
    def size(center: tuple[float, float], *corners: tuple[float, float]) -> tuple[int, int]:
        projection = np.array([[700, 0, center[0], 0], [0, 700, center[1], 0], [0, 0, 1, 0]], dtype=float)
        regions = np.array([(0, 0, *corner) for corner in corners], dtype=float).reshape(-1, 4)
        return assume_size(KittiCalibration(np.eye(4), projection), replace(Objects.none(), unlabelled=regions))

    assert size((609.6, 172.9)) == size((600, 180), (1241, 374)) == (375, 1242)
    assert size((1040.3, 319.5)) == (640, 2082)
    assert size((1040.3, 319.5), (2090, 617)) == (640, 2091)
    assert size((609.6, 319.5), (900, 700)) == (701, 1221)
