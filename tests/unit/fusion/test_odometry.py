"""LiDAR odometry on simulated drives, whose poses are known, and the import of a drive without poses."""

from pathlib import Path

import numpy as np
import pytest

from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.kitti import KittiFolder
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.fusion.registration import DrivenSource, Odometry, move_frame
from flcav.geometry import inverse, pose, transform_points
from flcav.sensors.frame import Frame
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

pytest.importorskip("small_gicp")
CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
LIDAR = "velodyne"


@pytest.fixture(scope="module")
def drive() -> list[Frame]:
    """Return 16 sweeps of a vehicle at speed, at 10 Hz."""
    recipe = Recipe(town="ring", seed=3, cavs=1, spins_per_scene=16, every_s=0.1, vehicle_rig=RIGS["kitti_lidar"])
    source = EmbeddedSource(recipe)
    return list(source.frames(source.scenes()[0]))


def test_a_drive_is_found_from_its_sweeps_alone(drive: list[Frame]) -> None:
    way, first = Odometry(), drive[0].world_from_sensor(LIDAR)
    for frame in drive:
        found, true = way.step(frame.lidar[LIDAR]), inverse(first) @ frame.world_from_sensor(LIDAR)
        np.testing.assert_allclose(found[:3, 3], true[:3, 3], atol=0.05)
        np.testing.assert_allclose(found[:3, :3], true[:3, :3], atol=0.003)
    assert np.linalg.norm(drive[-1].world_from_agent[:3, 3] - drive[0].world_from_agent[:3, 3]) > 8  # metres


def test_a_sweep_of_nothing_goes_on_as_before(drive: list[Frame]) -> None:
    way = Odometry()
    poses = [way.step(frame.lidar[LIDAR]) for frame in drive[:4]]
    lost = way.step(np.zeros((3, 4), np.float32))
    np.testing.assert_allclose(lost, poses[-1] @ inverse(poses[-2]) @ poses[-1], atol=1e-6)
    np.testing.assert_allclose(way.step(drive[5].lidar[LIDAR])[:3, 3], lost[:3, 3], atol=1.5)  # and is found again


def test_a_moved_frame_sees_the_same_from_elsewhere(drive: list[Frame]) -> None:
    frame, at = drive[3], pose(5.0, -2.0, 0.3, 1.0)
    moved = move_frame(frame, at)
    np.testing.assert_allclose(moved.world_from_agent, at)
    before, after = (
        each.annotations.boxes.transform(inverse(each.world_from_sensor(LIDAR))).array() for each in (frame, moved)
    )
    np.testing.assert_allclose(after, before, atol=1e-9)
    speeds = [np.linalg.norm(each.annotations.velocity, axis=1) for each in (frame, moved)]
    np.testing.assert_allclose(*speeds)


@pytest.fixture
def folder(tmp_path: Path, drive: list[Frame]) -> Path:
    """Return the drive as a folder of KITTI without poses, a labelled car with it."""
    root = tmp_path / "drive_1"
    (root / "velodyne").mkdir(parents=True)
    (root / "label_2").mkdir()
    (root / "calib.txt").write_text(CALIBRATION)
    rng = np.random.default_rng(0)
    for number, frame in enumerate(drive):
        at = np.array((20 - number / 10, 0, -0.85))
        car = np.column_stack((at + rng.uniform(-0.7, 0.7, (40, 3)), np.full(40, 0.5)))
        np.vstack((frame.lidar[LIDAR], car)).astype("<f4").tofile(root / "velodyne" / f"{number:06d}.bin")
        row = f"Car {number % 3} 0 0 560 160 640 220 1.5 1.7 4.0 0 1.6 {20 - number / 10} -1.57\n"
        (root / "label_2" / f"{number:06d}.txt").write_text(row)
    return root


@pytest.mark.slow
def test_a_drive_is_imported_with_the_poses_of_odometry(folder: Path, tmp_path: Path, drive: list[Frame]) -> None:
    notes = import_dataset("kitti", folder, tmp_path / "out", posed=DrivenSource)
    assert [note for note in notes if "image_2" in note]
    data = Dataset.open(tmp_path / "out")
    assert validate(tmp_path / "out") == []
    assert [key.time_s for key in data.keys] == pytest.approx([number / 10 for number in range(16)])
    assert {key.scene for key in data.keys} == {"kitti-drive_1"}
    first = inverse(drive[0].world_from_agent)
    for number, frame in enumerate(drive):
        found = data.frame(number)
        true = first @ frame.world_from_agent
        np.testing.assert_allclose(found.world_from_agent[:2, 3], true[:2, 3], atol=0.06)
        (center,) = transform_points(inverse(found.world_from_sensor(LIDAR)), found.annotations.boxes.center)
        np.testing.assert_allclose(center, (20 - number / 10, 0, -1.6 + 0.75), atol=1e-3)  # where its label has it
    plain = Dataset.open(_import(folder, tmp_path / "plain"))
    assert all((plain.world_from_agent(number) == np.eye(4)).all() for number in range(16))
    assert data.manifest.recipe["poses"] == "estimated"
    assert "poses" not in plain.manifest.recipe


def test_velocities_are_those_over_ground(folder: Path, tmp_path: Path, drive: list[Frame]) -> None:
    part = tmp_path / "in" / "training"
    (part / "label_02").mkdir(parents=True)
    (part / "calib").mkdir()
    (part / "velodyne").mkdir()
    (folder / "velodyne").rename(part / "velodyne" / "0000")
    (part / "calib" / "0000.txt").write_text(CALIBRATION)
    stands = (drive[0].world_from_sensor(LIDAR) @ (25.0, 4.0, -0.85, 1.0))[:3]
    rows = []
    for number, frame in enumerate(drive):
        (parked,) = transform_points(inverse(frame.world_from_sensor(LIDAR)), stands[None])
        for track, (x, y, z) in ((3, (20 - number / 10, 0.0, -0.85)), (7, parked)):
            rows.append(f"{number} {track} Car 0 0 0 560 160 640 220 1.5 1.7 4.0 {-y} {0.75 - z} {x} -1.57\n")
    (part / "label_02" / "0000.txt").write_text("".join(rows))
    import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out", posed=DrivenSource)
    data, true = Dataset.open(tmp_path / "out"), np.zeros(3)
    for number in range(1, len(drive) - 1):
        ahead, parked = data.frame(number).annotations.velocity
        before, after = (
            drive[n].world_from_sensor(LIDAR) @ (20 - n / 10, 0, -0.85, 1) for n in (number - 1, number + 1)
        )
        true = inverse(drive[0].world_from_agent)[:3, :3] @ ((after - before)[:3] / 0.2)
        np.testing.assert_allclose(ahead[:2], true[:2], atol=0.4)
        np.testing.assert_allclose(parked[:2], 0, atol=0.4)
    assert np.linalg.norm(true) > 4


def _import(folder: Path, out: Path) -> Path:
    import_dataset("kitti", folder, out)
    return out


def test_levels_of_truncation_stand_for_shares(folder: Path, tmp_path: Path) -> None:
    frames = KittiFolder.open(folder, pictures=False)
    assert [frames.frame(number).objects.truncation.tolist() for number in range(3)] == [[0.0], [0.25], [0.75]]
