"""KITTI's tracking benchmark: made sequences are read as its devkit defines them; the real one is at hand in part."""

import os
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from painted_source import BARE

from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset

DATA = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "real"
IMU_FROM_LIDAR = [[1, 0, 0, 0.81], [0, 1, 0, -0.32], [0, 0, 1, 0.8]]
CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_velo 1 0 0 -0.81 0 1 0 0.32 0 0 1 -0.8
"""  # the benchmark's names, without colons
FRAMES = 4
SPEED, RATE = 12.0, 0.1  # [m/s], [rad/s]: of the vehicle
LATITUDE, LONGITUDE = 49.0, 8.4
EARTH_M = 6378137.0


def drive(folder: Path) -> Path:
    """Write a sequence of a vehicle that curves past a car that stands, and a Person (sitting)."""
    part = folder / "training"
    for name in ("velodyne/0007", "label_02", "calib", "oxts"):
        (part / name).mkdir(parents=True)
    (part / "calib" / "0007.txt").write_text(CALIBRATION)
    log, labels, world_from_imu = [], [], np.eye(4)
    east = north = 0.0
    for i in range(FRAMES):
        yaw = 0.3 + RATE * i / 10
        east, north = east + SPEED / 10 * np.cos(yaw) * (i > 0), north + SPEED / 10 * np.sin(yaw) * (i > 0)
        scale = np.cos(np.radians(LATITUDE)) * EARTH_M
        at = (
            LATITUDE + np.degrees(north * np.cos(np.radians(LATITUDE)) / scale),
            LONGITUDE + np.degrees(east / scale),
            116.0,
        )
        log.append(" ".join(f"{value:.12f}" for value in (*at, 0.01, -0.02, yaw, *[0.0] * 24)))
        rotation = about_z(yaw) @ about_y(-0.02) @ about_x(0.01)
        world_from_imu[:3, :3], world_from_imu[:3, 3] = rotation, (east, north, 0)
        imu_from_lidar = np.vstack((IMU_FROM_LIDAR, [0, 0, 0, 1]))
        x, y, z = (np.linalg.inv(world_from_imu @ imu_from_lidar) @ (20.0, 8.0, -1.0, 1.0))[:3]
        labels += [
            f"{i} 3 Car 0 1 -10 100 100 200 200 1.5 1.6 4.0 {-y} {-z + 0.75} {x} -1.57",
            f"{i} 5 Person 0 0 -10 300 100 320 200 1.2 0.6 0.8 {-y - 3} {-z + 0.6} {x} 0",
            f"{i} -1 DontCare -1 -1 -10 1 1 9 9 -1000 -1000 -1000 -10 -1 -1 -1",
        ]
        np.tile([x, y, z, 0.5], (7, 1)).astype("<f4").tofile(part / "velodyne" / "0007" / f"{i:06d}.bin")
    (part / "oxts" / "0007.txt").write_text("\n".join(log))
    (part / "label_02" / "0007.txt").write_text("\n".join(labels))
    return folder


def about_x(a: float) -> np.ndarray:
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def about_y(a: float) -> np.ndarray:
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def about_z(a: float) -> np.ndarray:
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


def mercator(log: np.ndarray) -> np.ndarray:
    """Return the poses of the devkit's convertOxtsToPose: Mercator's projection, scaled at the first latitude."""
    scale, poses = np.cos(np.radians(log[0, 0])), []
    for latitude, longitude, altitude, roll, pitch, yaw in log[:, :6]:
        pose = np.eye(4)
        pose[:3, 3] = (
            scale * np.radians(longitude) * EARTH_M,
            scale * EARTH_M * np.log(np.tan(np.radians(90 + latitude) / 2)),
            altitude,
        )
        pose[:3, :3] = about_z(yaw) @ about_y(pitch) @ about_x(roll)
        poses.append(pose)
    return np.linalg.inv(poses[0]) @ np.array(poses)


def test_poses_tracks_and_velocities(tmp_path: Path) -> None:
    drive(tmp_path / "in")
    notes = import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out")
    assert notes == (*BARE, "no image_02 of 1 of 1 sequence, so LiDAR alone there: 0007")
    data = Dataset.open(tmp_path / "out")
    frames = [data.frame(i) for i in range(len(data))]
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert {frame.scene for frame in frames} == {"kitti-training-0007"}
    found = np.array([frame.world_from_sensor("velodyne") for frame in frames])
    log = np.loadtxt(tmp_path / "in" / "training" / "oxts" / "0007.txt")
    imu_from_lidar = np.vstack((IMU_FROM_LIDAR, [0, 0, 0, 1]))
    expected = np.linalg.inv(imu_from_lidar) @ mercator(log) @ imu_from_lidar
    np.testing.assert_allclose(np.linalg.inv(found[0]) @ found, expected, atol=0.02)  # Earth is no sphere: .3 %
    for frame in frames:
        known = frame.annotations
        assert known.track.tolist() == ["3", "5"]
        assert known.boxes.label.tolist() == ["car", "Person_sitting"]
        assert known.returns.tolist() == [7, 0]
    centres = np.array([frame.annotations.boxes.center[0] for frame in frames])
    np.testing.assert_allclose(centres, np.tile(centres[:1], (FRAMES, 1)), atol=0.02)  # it stands
    speeds = np.linalg.norm([frame.annotations.velocity[0] for frame in frames], axis=1)
    assert speeds.max() < 0.1


def test_without_a_log_frames_stand_alone_and_a_sweep_may_be_missing(tmp_path: Path) -> None:
    """Sequence 0001 of the benchmark lacks four sweeps."""
    part = drive(tmp_path / "in") / "training"
    shutil.rmtree(part / "oxts")
    (part / "velodyne" / "0007" / "000002.bin").unlink()
    labels = part / "label_02" / "0007.txt"
    labels.write_text("".join(line for line in labels.read_text().splitlines(True) if not line.startswith("2 ")))
    notes = import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out")
    assert notes[2] == "no oxts of 1 of 1 sequence, so no poses there, which --estimate-poses estimates: 0007"
    data = Dataset.open(tmp_path / "out")
    assert [data.frame(i).time_s for i in range(len(data))] == pytest.approx([0.0, 0.1, 0.3])
    assert all(np.isnan(data.frame(i).annotations.velocity).all() for i in range(len(data)))
    np.testing.assert_array_equal(data.frame(2).world_from_agent, np.eye(4))


@pytest.mark.parametrize(
    ("file", "change", "told"),
    [
        ("label_02/0007.txt", ("0 3 Car", "zero 3 Car"), "line 1 does not begin with a frame and a track"),
        ("label_02/0007.txt", ("0 5 Person", "0 3 Person"), "line 2: the track 3 is in frame 0 already"),
        ("label_02/0007.txt", ("3 5 Person", "9 5 Person"), "labels frame 9, of which there is no sweep"),
        ("label_02/0007.txt", (" Car 0 1", " Ship 0 1"), "unknown class 'Ship'"),
        ("oxts/0007.txt", ("49.0", "490.0"), "line 1 has no latitude, longitude, altitude, roll, pitch and yaw"),
        ("calib/0007.txt", ("Tr_imu_velo", "Tr_x"), "needs 12 numbers after 'Tr_imu_to_velo:'"),
        ("calib/0007.txt", ("P2:", "P9:"), "needs 12 numbers after 'P2:'"),
    ],
)
def test_a_fault_is_named(file: str, change: tuple[str, str], told: str, tmp_path: Path) -> None:
    path = drive(tmp_path / "in") / "training" / file
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(InputError, match=re.escape(told)):
        import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with pytest.raises(InputError, match="no sequence of KITTI's tracking benchmark"):
        import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out")


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "kitti_tracking_0000").is_dir(), reason=f"no {DATA / 'kitti_tracking_0000'}")
def test_the_real_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["unpack.py", str(tmp_path / "in")])
    runpy.run_path(str(DATA / "kitti_tracking_0000" / "unpack.py"))
    import_dataset("kitti-tracking", tmp_path / "in", tmp_path / "out")
    data = Dataset.open(tmp_path / "out")
    assert len(data) == 154
    lines = (tmp_path / "in" / "training" / "label_02" / "0000.txt").read_text().splitlines()
    tracks = {line.split()[1] for line in lines if " DontCare " not in line}
    found = [data.frame(i).annotations for i in range(len(data))]
    assert set().union(*(known.track.tolist() for known in found)) == tracks
    near = np.concatenate([known.returns for known in found])
    assert (near > 0).mean() > 0.95  # labels are of the same frame as the points
