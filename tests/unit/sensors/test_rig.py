import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.sensors.lens import Lens, project_optical
from flcav.sensors.rig import RIGS, CalibrationError, Rig, build_calibration, perturb_calibration


def rig(**kinds: object) -> Rig:
    return parse_config(Rig, kinds, "rig")


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        ({}, "at least one LiDAR or camera"),
        ({"radars": {"radar": {}}}, "at least one LiDAR or camera"),
        ({"lidars": {"top": {}}, "cameras": {"top": {}}}, "two sensors are called 'top'"),
        ({"lidars": {"../top": {}}}, "sensor name '../top': must be letters"),
        ({"lidars": {"traces": {}}}, "sensor name 'traces'"),
        ({"lidars": {101 * "t": {}}}, "digits, - and _, 100 at most"),
        ({"cameras": {"front": {"trigger_ms": 300}}}, "trigger_ms' = 300"),
        ({"lidars": {"top": {"trigger_ms": 3}}}, "unknown field 'lidars.top.trigger_ms'"),
    ],
)
def test_impossible_rigs_get_one_sentence(kinds: dict, message: str):
    with pytest.raises(InputError, match=message) as error:
        rig(**kinds)
    assert "\n" not in str(error.value)


def test_the_cars_lidar_is_the_same_in_every_rig():
    assert RIGS["car"].lidars == RIGS["car_surround"].lidars == RIGS["lidar32"].lidars
    assert RIGS["roadside"].lidars == RIGS["lidar_pole"].lidars


def test_six_cameras_leave_no_direction_unseen():
    calibration = build_calibration(RIGS["car_surround"])
    azimuth = np.radians(np.arange(0, 360, 1.0))
    seen = np.zeros(len(azimuth), bool)
    for name, camera in RIGS["car_surround"].cameras.items():
        agent_from_camera = calibration.agent_from_sensor[name]
        far = 1e4 * np.stack((np.cos(azimuth), np.sin(azimuth), 0 * azimuth), axis=1)
        pixels = project_optical(camera.settings, (far - agent_from_camera[:3, 3]) @ agent_from_camera[:3, :3])
        seen |= (pixels[:, 0] >= 0) & (pixels[:, 0] <= camera.settings.width - 1)
    assert seen.all()


def test_kittis_lidar_projects_as_in_its_own_calibration_file():
    """By `P2 R0_rect Tr_velo_to_cam` of the 26 September 2011 the point is seen at (539.0, 215.1).

    Their camera is pitched by 0.7 degrees against the LiDAR, which is 9 rows; ours is level.
    """
    calibration = build_calibration(RIGS["kitti"])
    mounts = calibration.agent_from_sensor
    camera_from_lidar = np.linalg.inv(mounts["image_2"]) @ mounts["velodyne"]
    ahead = camera_from_lidar @ (20.0, 2.0, -1.0, 1.0)
    u, v, w = calibration.intrinsics["image_2"] @ ahead[:3]
    assert u / w == pytest.approx(539.0, abs=1.0)
    assert v / w == pytest.approx(215.1 - 721.5 * np.radians(0.68), abs=1.0)
    assert RIGS["kitti"].lidars["velodyne"].settings.channels == 64
    assert (RIGS["kitti"].cameras["image_2"].settings.width, RIGS["kitti"].cameras["image_2"].settings.height) == (
        1242,
        375,
    )


def test_a_camera_looks_along_its_mounts_x():
    look = rig(cameras={"left": {"mount": {"z": 2.0, "yaw_deg": 90.0, "pitch_deg": 10.0}}})
    mount = build_calibration(look).agent_from_sensor["left"]
    np.testing.assert_allclose(mount[:3, 2], (0, np.cos(np.radians(10)), -np.sin(np.radians(10))), atol=1e-12)
    np.testing.assert_allclose(mount[:3, 0], (1, 0, 0), atol=1e-12)  # to its right is where the car goes


def test_errors_are_drawn_once_per_sensor_agent_and_seed():
    true = build_calibration(RIGS["car"])
    error = CalibrationError(position_m=0.1, rotation_deg=1.0, focal_px=3.0, time_ms=4.0)
    one, again = (perturb_calibration(true, error, seed=1, agent="cav0") for _ in range(2))
    others = (
        perturb_calibration(true, error, seed=2, agent="cav0"),
        perturb_calibration(true, error, seed=1, agent="cav1"),
    )
    for name in true.agent_from_sensor:
        np.testing.assert_array_equal(one.agent_from_sensor[name], again.agent_from_sensor[name])
        assert not any(np.allclose(one.agent_from_sensor[name], other.agent_from_sensor[name]) for other in others)
    assert one.offset_ms == again.offset_ms != true.offset_ms
    np.testing.assert_array_equal(one.distortion["camera"], true.distortion["camera"])
    assert perturb_calibration(true, CalibrationError(), seed=1, agent="cav0") is true


def test_errors_have_the_size_asked_for():
    true = build_calibration(rig(cameras={"front": {}}))
    error = CalibrationError(position_m=0.1, rotation_deg=2.0, focal_px=3.0, time_ms=4.0)
    drawn = [perturb_calibration(true, error, seed=seed, agent="cav0") for seed in range(400)]
    between = np.array(
        [np.linalg.inv(true.agent_from_sensor["front"]) @ one.agent_from_sensor["front"] for one in drawn]
    )
    assert between[:, :3, 3].std() == pytest.approx(0.1, rel=0.1)
    angle = np.degrees(np.arccos(np.clip((np.trace(between[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.sqrt((angle**2).mean() / 3) == pytest.approx(2.0, rel=0.1)
    focal = np.array([one.intrinsics["front"][[0, 1], [0, 1]] - true.intrinsics["front"][0, 0] for one in drawn])
    np.testing.assert_allclose(focal[:, 0], focal[:, 1])
    assert focal.std() == pytest.approx(3.0, rel=0.1)
    assert np.std([one.offset_ms["front"] for one in drawn]) == pytest.approx(4.0, rel=0.1)


def test_intrinsics_are_the_lenss():
    lens = Lens(width=640, height=384, fov_deg=90.0)
    matrix = build_calibration(rig(cameras={"front": {"settings": {"width": 640, "height": 384}}})).intrinsics["front"]
    np.testing.assert_array_equal(matrix, lens.intrinsics())
