"""Points and labels that are not in metres, x ahead, y left, z up: named by what shows it; genuine ones are not."""

import contextlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kitti_folders import LABEL, cast, write_folder

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.kitti import KittiFolder
from flcav.dataset.formats.mounting import estimate_mounting, find_other_frame
from flcav.dataset.formats.rig import StatedLidar
from flcav.dataset.formats.sweeps import read_cloud_file
from flcav.dataset.scene_checks import EmptyBoxes
from flcav.geometry import inverse, pose, transform_points
from flcav.perception.networks import evaluate, infer
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.predict import read_point_clouds
from flcav.perception.objects.samples import find_rigs
from flcav.perception.objects.task import OBJECTS

DATA = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data"))
SWEEPS = ("kitti_frame/training/velodyne/*.bin", "real/astyx/training/velodyne/0001[05]0.bin", "found/lidar/*/*.bin")
CONFIG = OBJECTS.configurations["tiny"]
TURNED = {  # what a file's x, y, z are of x ahead, y left, z up
    "z points down by the ground": np.diag([1, -1, -1]),
    "y points down, as in a camera's frame by the ground": np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "y points up by the ground": np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]]),
    "x points up by the ground": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "x points down by the ground": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
}
ASIDE = {"y": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "-y": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "-x": np.diag([-1, -1, 1])}


def changed(cloud: np.ndarray, matrix: object) -> np.ndarray:
    return np.column_stack((cloud[:, :3] @ np.asarray(matrix).T, cloud[:, 3:])).astype(np.float32)


@pytest.mark.parametrize("beams", [16, 32])
def test_axes_and_units_are_told_by_the_ground(beams: int) -> None:
    clouds = [cast(beams, 1.7, 0.02, -0.03, 0)]
    assert find_other_frame(clouds) == ""
    for said, matrix in TURNED.items():
        assert find_other_frame([changed(cloud, matrix) for cloud in clouds]).startswith(f"{said}; wanted are")
    for scale, unit in ((100, "centimetres"), (1000, "millimetres")):
        assert f"not metres, {unit} by the height" in find_other_frame([changed(c, scale * np.eye(3)) for c in clouds])


def test_a_sweep_to_one_side_tells_what_is_ahead() -> None:
    cloud = cast(64, 1.7, 0, 0, 0)
    ahead = cloud[np.abs(cloud[:, 1]) < cloud[:, 0]]
    assert find_other_frame([ahead]) == ""
    for axis, matrix in ASIDE.items():
        turned = changed(ahead, matrix)
        assert find_other_frame([turned]).startswith(f"all points lie towards {axis}, which must be ahead; wanted")
        assert find_other_frame([turned], placed=True) == ""
        assert find_other_frame([changed(cloud, matrix)]) == ""  # to all sides


def test_two_beams_and_streets_without_ground_are_left_alone() -> None:
    clouds = [cast(2, 1.8, 0, 0, seed) for seed in range(4)]
    clouds += [cast(16, 1.7, 0, 0, 0, ground=False), np.zeros((0, 4), np.float32)]
    assert [find_other_frame([cloud]) for cloud in clouds] == [""] * 6


def test_points_in_a_vehicles_frame_have_their_ground_at_its_origin() -> None:
    cloud = cast(32, 1.9, 0, 0, 0)
    cloud[:, 2] += 1.57
    found = estimate_mounting([cloud])
    assert found is not None
    assert found.height_m == pytest.approx(0.33, abs=0.02)
    assert find_other_frame([changed(cloud, np.diag([1, -1, -1]))]).startswith("z points down")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real sweeps at {DATA}; set FLCAV_REAL_DATA")
@pytest.mark.parametrize("pattern", SWEEPS)
def test_real_sweeps_are_told_turned_and_left_alone_as_they_are(pattern: str) -> None:
    paths = sorted(DATA.glob(pattern))[:2]
    clouds = [read_cloud_file(path) for path in paths]
    assert clouds
    assert [find_other_frame([cloud]) for cloud in clouds] == [""] * len(clouds)
    for said, matrix in TURNED.items():
        assert find_other_frame([changed(clouds[0], matrix)]).startswith(said)
    assert "millimetres" in find_other_frame([changed(clouds[0], 1000 * np.eye(3))])


FAULTS = {
    "z points down by the ground; wanted": lambda cloud: changed(cloud, np.diag([1, -1, -1])),
    r"coordinates up to \d+, millimetres by their size": lambda cloud: changed(cloud, 1000 * np.eye(3)),
    "point 3 is not finite": lambda cloud: np.where(np.arange(len(cloud))[:, None] == 3, np.nan, cloud),
    "empty; a point cloud holds": lambda cloud: cloud[:0],
}


@pytest.mark.parametrize("said", FAULTS)
def test_infer_evaluate_and_import_refuse_alike(said: str, tmp_path: Path) -> None:
    write_folder(tmp_path / "in", [FAULTS[said](cast(16, 1.7, 0, 0, 0)).astype(np.float32)])
    file, network = tmp_path / "in/training/velodyne/000000.bin", second_tiny()
    with pytest.raises(InputError, match=rf"^{file}: {said}"):
        infer("objects", file, network)
    with pytest.raises(InputError, match=rf"^{file}: {said}"):
        evaluate("objects", tmp_path / "in", network)
    with pytest.raises(InputError, match=rf"^{file}: {said}"):
        import_dataset("kitti", tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_labels_of_another_frame_are_refused_with_their_count(tmp_path: Path) -> None:
    clouds = [cast(16, 1.7, 0, 0, seed) for seed in range(5)]
    write_folder(tmp_path / "right", clouds)
    import_dataset("kitti", tmp_path / "right", tmp_path / "out")
    aside = LABEL.replace("0.0 1.5 14.0", "-14.0 1.5 0.0")  # x and y exchanged: behind a wall
    write_folder(tmp_path / "wrong", clouds, aside)
    said = r"0 of 5 boxes within 40 m of the LiDARs, .* have points above the ground: labels and points are not in one"
    with pytest.raises(InputError, match=said):
        import_dataset("kitti", tmp_path / "wrong", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match=said):
        evaluate("objects", tmp_path / "wrong", second_tiny())


def test_a_file_is_levelled_and_its_boxes_come_back(tmp_path: Path) -> None:
    mount = pose(0, 0, 1.2, 0, 0.09, -0.1)
    level = cast(64, 1.2, 0, 0, 0)
    tilted = level.copy()
    tilted[:, :3] = transform_points(inverse(mount) @ pose(0, 0, 1.2), level[:, :3])
    tilted.tofile(tmp_path / "a.bin")
    rig = find_rigs([tmp_path / "a.bin"], CONFIG, StatedLidar())[tmp_path]
    (cloud,) = read_point_clouds(tmp_path / "a.bin", None, CONFIG, rig.agent_from_lidar)
    assert cloud.move is not None
    expected = transform_points(pose(0, 0, 1.2 + CONFIG.ground_z_m), level[:, :3])
    np.testing.assert_allclose(transform_points(cloud.move, cloud.points[:, :3])[:, 2], expected[:, 2], atol=0.5)
    (note,) = rig.notes
    assert note.startswith("the ground of 1 sweep lies 1.20 m (+- 0.0")
    assert note.endswith(", and the LiDAR is tilted by 8 degrees against it (corrected)")
    stated = find_rigs([tmp_path / "a.bin"], CONFIG, StatedLidar(2.0, 20))[tmp_path]
    assert (stated.agent_from_lidar[2, 3], stated.beams) == (2.0, 20)


def test_the_first_line_says_what_is_corrected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    low, bare = tmp_path / "low", tmp_path / "bare"
    for folder, cloud in ((low, cast(16, 1.3, 0, 0, 0)), (bare, cast(64, 1.7, 0, 0, 0, ground=False))):
        folder.mkdir()
        cloud.tofile(folder / "a.bin")
    with pytest.raises(SystemExit) as end:
        run(["infer", "objects", str(low), str(bare / "a.bin"), "--threshold", "0.99"])
    lines = capsys.readouterr().out.splitlines()
    assert not end.value.code
    assert lines[0].startswith(f"{low}: the ground of 1 sweep lies 1.30 m (+- 0.0")
    assert lines[0].endswith("not the network's 1.73 m (corrected)")
    assert lines[1] == f"{bare}: no ground near the LiDAR in 1 sweep, so it is taken to be 1.73 m above it"
    with pytest.raises(SystemExit):
        run(["infer", "objects", str(low), "--threshold", "0.99", "--beams", "8"])
    few = capsys.readouterr().out.splitlines()[0]
    assert few.endswith("unlike in the network's training the LiDAR has 8 beams, not 16 to 128")


def test_height_and_beams_are_of_files_alone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--lidar-height and --beams: only point clouds of a vehicle in files"):
        infer("weather", tmp_path, lidar=StatedLidar(1.5))


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real frames at {DATA}; set FLCAV_REAL_DATA")
def test_labels_of_real_frames_are_refused_moved_and_left_alone_as_they_are() -> None:
    folder = KittiFolder.open(DATA / "kitti_frame", pictures=False)
    frame = folder.frame(0)
    boxes, names = frame.objects.boxes, np.array([str(row) for row in range(len(frame.objects.boxes))])
    moved = {
        "": boxes,
        "lifted": replace(boxes, center=boxes.center + np.array((0, 0, 3))),
        "in millimetres": replace(boxes, center=1000 * boxes.center),
        "in the camera's frame": replace(boxes, center=boxes.center @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
        "in the world's": replace(boxes, center=boxes.center + np.array((300, 100, 0))),
    }
    for how, found in moved.items():
        checked = EmptyBoxes()
        checked.count(found, [(frame.points, np.eye(4))], names, np.zeros(len(names)), "ego", "scene", "frame")
        with pytest.raises(InputError, match="0 of 6 boxes") if how else contextlib.nullcontext():
            checked.refuse(DATA)
