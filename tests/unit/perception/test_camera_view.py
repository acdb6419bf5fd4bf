"""Where points fall on a picture, against the renderer's own depths, KITTI's formula and what can be seen by eye."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from PIL import Image

from flcav.config import InputError
from flcav.dataset.formats.kitti import KittiCalibration
from flcav.dataset.formats.kitti.write import format_calibration
from flcav.geometry import Boxes, transform_points
from flcav.perception.images import CameraView, kitti_view, recorded_view, view_beside
from flcav.perception.marks import CloudBoxes
from flcav.perception.objects.predict import ObjectsFound, boxes_to_rows, rows_to_boxes
from flcav.perception.task import Finding
from flcav.report import style
from flcav.report.pictures.camera import ALONG
from flcav.report.pictures.inference import draw
from flcav.sensors.frame import Frame
from flcav.sensors.observe import observe
from flcav.sensors.rig import CalibrationError, Rig, perturb_calibration
from flcav.world.scene import Scene

LENS = {"width": 320, "height": 192, "fov_deg": 80.0}
BENT = {**LENS, "k1": -0.15, "p1": 0.002}
LIDAR = {"mount": {"z": 1.8}, "settings": {"channels": 32, "azimuth_steps": 900}}
LOW, ASIDE, BEHIND = ({"x": 0.4, "z": 1.5, "yaw_deg": yaw} for yaw in (6.0, 90.0, 178.0))
CAR_AHEAD = ("veh1", "car", 0, 12.0, -2.0, 0.1)
OPTICAL = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)


@pytest.fixture(scope="module")
def seen(small_town, standing):
    street = Scene(small_town(), standing([("cav0", "car", 3, 0.0, -2.0, 0.0), CAR_AHEAD]))

    def look(mounts) -> Frame:
        cameras = {name: {"mount": mount, "settings": BENT} for name, mount in mounts.items()}
        rig = Rig.model_validate({"lidars": {"top": LIDAR}, "cameras": cameras})
        return observe(street, rig, "cav0", 0, scene_name="s", seed=1)

    return look


def test_points_fall_where_the_renderer_has_their_depth(seen, recorded, tmp_path):
    frame = seen({"left": ASIDE, "front": LOW, "rear": BEHIND})
    view = recorded_view(recorded(frame, tmp_path), 0, "top")
    assert view is not None
    np.testing.assert_array_equal(view.picture, frame.images["front"].rgb)
    points = frame.lidar["top"][:, :3].astype(float)
    points = points[view.shows(points)]
    assert len(points) > 1000
    column, row = np.rint(view.project(points)).astype(int).T
    error = np.abs(frame.images["front"].depth_m[row, column] - transform_points(view.camera_from_points, points)[:, 2])
    assert np.median(error) < 0.05
    assert (error < 0.5).mean() > 0.9


def test_it_is_drawn_as_the_agent_believes_its_sensors_to_be(seen, recorded, tmp_path):
    frame = seen({"front": LOW})
    believed = perturb_calibration(frame.calibration, CalibrationError(rotation_deg=1.0), seed=1, agent="cav0")
    view = recorded_view(recorded(replace(frame, assumed=believed), tmp_path), 0, "top")
    assert view is not None
    from_top = np.linalg.inv(believed.agent_from_sensor["front"]) @ believed.agent_from_sensor["top"]
    np.testing.assert_allclose(view.camera_from_points, from_top, atol=1e-9)


@pytest.mark.parametrize("mounts", [{}, {"left": ASIDE, "rear": BEHIND}])
def test_where_no_camera_looks_ahead_there_is_no_view(mounts, seen, recorded, tmp_path):
    assert recorded_view(recorded(seen(mounts), tmp_path), 0, "top") is None


def real_like() -> KittiCalibration:
    """Return KITTI's: a projection that also shifts, a camera that is tilted against the LiDAR."""
    turned = OPTICAL.copy()
    turned[:3, :3] = (
        np.array([[1, 0, 0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]]) @ turned[:3, :3]
    )
    turned[:3, 3] = (-0.004, -0.08, -0.27)
    return KittiCalibration(turned, np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]]))


def test_kitti_s_projection_is_its_formula():
    calibration = real_like()
    points = np.random.default_rng(0).uniform((-5, -9, -2), (40, 9, 2), (300, 3))
    homogeneous = np.c_[points, np.ones(300)] @ (calibration.image_from_camera @ calibration.camera_from_lidar).T
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    view = kitti_view(np.zeros((375, 1242, 3), np.uint8), calibration)
    inside = (homogeneous[:, 2] > 0.2) & (np.abs(pixels - (621, 187)) <= (621, 187)).all(axis=1)
    assert 20 < inside.sum() < 280
    np.testing.assert_allclose(view.project(points)[inside], pixels[inside], atol=1e-6)
    np.testing.assert_array_equal(view.shows(points), inside)
    assert np.isnan(view.project(np.array([(-3.0, 0, 0), (0.28, 0, 0)]))).all()


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder in KITTI's layout: a point cloud with its picture and calibration."""
    for name in ("velodyne", "image_2", "calib"):
        (tmp_path / name).mkdir()
    Image.fromarray(np.full((60, 200, 3), 90, np.uint8)).save(tmp_path / "image_2" / "000003.png")
    lines = format_calibration(np.array([[100.0, 0, 99.5], [0, 100, 29.5], [0, 0, 1]]), OPTICAL, np.eye(4))
    (tmp_path / "calib" / "000003.txt").write_text("\n".join(lines))
    np.ones((9, 4), "<f4").tofile(tmp_path / "velodyne" / "000003.bin")
    return tmp_path


def test_a_view_beside_a_point_cloud(folder):
    view = view_beside(folder / "velodyne" / "000003.bin")
    assert view is not None
    assert view.picture.shape == (60, 200, 3)
    np.testing.assert_allclose(view.project(np.array([(10.0, 1.0, 0.0)])), [(89.5, 29.5)])
    assert view_beside(folder / "velodyne" / "000004.bin") is None
    flat = "P2:" + " 0" * 12 + "\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    (folder / "calib" / "000003.txt").write_text(flat)
    with pytest.raises(InputError, match="'P2:' are no projection"):
        view_beside(folder / "velodyne" / "000003.bin")
    (folder / "image_2" / "000003.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"image_2/000003\.png: not a picture"):
        view_beside(folder / "velodyne" / "000003.bin")


def finding(*places, view: CameraView | None) -> Finding:
    rows = np.array([(x, y, -1.0, 4.0, 1.6, 1.5, 0.3) for x, y in places]).reshape(-1, 7)
    boxes = Boxes.from_array(rows, "Car", np.full(len(rows), 0.9))
    points = np.pad(np.random.default_rng(0).uniform((1, -9, -2), (40, 9, 1), (500, 3)), ((0, 0), (0, 1)))
    return Finding(
        Path("000003.bin"),
        points.astype(np.float32),
        ObjectsFound(boxes_to_rows(boxes)),
        (CloudBoxes(boxes),),
        lambda: view,
    )


def test_a_picture_is_above_the_cloud_where_there_is_one(folder):
    view = view_beside(folder / "velodyne" / "000003.bin")
    shown = {len(places): style.png(draw(finding(*places, view=view)), 40) for places in ([], [(12, 0)])}
    assert shown[0] != shown[1]
    assert len(draw(finding((12, 0), view=view)).axes) == 3  # picture, cloud, scale of distances
    assert len(draw(finding((12, 0), view=None)).axes) == 1


def test_boxes_are_drawn_as_far_as_the_camera_can_see_them(folder):
    view = view_beside(folder / "velodyne" / "000003.bin")

    def drawn(*place: float) -> int:
        axes = draw(finding(place, view=view)).axes[0]
        edges = [
            edge for lines in axes.collections if isinstance(lines, LineCollection) for edge in lines.get_segments()
        ]
        return sum(int(np.isfinite(edge).all(1).sum()) for edge in edges if len(edge))

    lines = 13 * len(ALONG)  # twelve edges and the tick
    assert drawn(12, 0) == lines
    assert 0 < drawn(0.5, 0) < lines
    assert drawn(-9, 0) == 0


def test_far_boxes_are_within_the_picture_from_above():
    (axes,) = draw(finding((66, -34), view=None)).axes
    assert axes.get_xlim()[1] > 36
    assert axes.get_ylim()[1] > 68


def test_rows_of_boxes_come_back():
    boxes = Boxes.from_array([[1, 2, 3, 4, 5, 6, 0.7]], "Cyclist", [0.4])
    again = rows_to_boxes(boxes_to_rows(boxes))
    np.testing.assert_allclose(again.array(), boxes.array())
    assert again.label.tolist() == ["Cyclist"]
    np.testing.assert_array_equal(again.score, [0.4])
    assert len(rows_to_boxes([])) == 0
