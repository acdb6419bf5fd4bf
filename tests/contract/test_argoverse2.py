"""Logs of Argoverse 2: one written here with poses computed by hand, and a real one where there is one."""

import os
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pytest
from argoverse2_log import NORTH, START, UP_LIDAR, write_log
from scipy.spatial.transform import Rotation

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.reading import difference_tracks
from flcav.dataset.scene_checks import find_copies
from flcav.dataset.store import Dataset
from flcav.dataset.validation import find_leaks, validate
from flcav.geometry import inverse, transform_points

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[3] / "shared" / "data")) / "argoverse2"


def test_a_log_is_imported_with_poses_boxes_and_linked_pictures(tmp_path: Path):
    log = tmp_path / "logs" / "val" / "one"
    write_log(log)
    assert import_dataset("argoverse2", tmp_path / "logs", tmp_path / "out", split="val") == ()
    assert validate(tmp_path / "out") == []
    data = Dataset.open(tmp_path / "out")
    assert data.manifest.recipe["splits"] == {"val": ["one"]}
    frame, later = data.frame(0), data.frame(1)
    assert later.time_s - frame.time_s == pytest.approx(0.1, abs=1e-6)
    np.testing.assert_allclose(frame.world_from_agent[:3, 3], (100, 200, 60 - 0.33))  # on the ground
    np.testing.assert_allclose(frame.agent_from_sensor["lidar"][:3, 3], np.add(UP_LIDAR, (0, 0, 0.33)))
    np.testing.assert_allclose(frame.lidar["lidar"][0], (20 - 1.35, 0, 0.5 - 1.64, 0), atol=1e-6)
    assert frame.lidar["lidar"][:, 3].tolist() == pytest.approx([0, 0.2, 1])
    truth = frame.annotations
    assert truth.boxes.label.tolist() == ["car", "CONSTRUCTION_CONE"]
    np.testing.assert_allclose(truth.boxes.center[0], (100, 220, 60.4), atol=1e-9)  # 20 m north of the ego vehicle
    np.testing.assert_allclose(truth.boxes.yaw[0], -np.pi / 2)  # it comes towards it
    np.testing.assert_allclose(truth.velocity[0], 0, atol=1e-9)
    assert np.isnan(truth.velocity[1]).all()  # annotated once
    assert np.isnan(truth.occlusion).all()
    assert truth.returns.tolist() == [2, 0]
    path = data.plane_path(0, "ring_front_center", "rgb")
    assert path.resolve() == next((log / "sensors" / "cameras" / "ring_front_center").iterdir()).parent / (
        f"{START + 20_000_000}.jpg"
    )
    assert frame.images["ring_front_center"].rgb.shape == (96, 160, 3)
    assert frame.images["ring_front_center"].instance is None
    np.testing.assert_allclose(frame.world_from_sensor("ring_front_center")[:3, 3], (100, 200.1 + 1.6, 61.4))
    x1, y1, x2, y2 = truth.views["ring_front_center"].amodal_box[0]  # its near end is 20 - 2 - .1 - 1.6 m ahead
    assert (x1, x2) == (pytest.approx(79.5 - 90 / 16.3), pytest.approx(79.5 + 90 / 16.3))
    assert (y1, y2) == (pytest.approx(47.5 + 25 / 20.3), pytest.approx(47.5 + 175 / 16.3))


def test_boxes_of_a_vehicle_on_a_slope_are_tilted_as_it_is(tmp_path: Path):
    attitude = NORTH * Rotation.from_euler("YX", (6, -3), degrees=True)
    write_log(tmp_path / "log", attitude=attitude)
    import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    truth = Dataset.open(tmp_path / "out").frame(0).annotations
    turned = (attitude * Rotation.from_euler("z", 180, degrees=True)).as_matrix()
    np.testing.assert_allclose(truth.boxes.rotations(), [turned, turned], atol=1e-9)
    assert truth.returns.tolist() == [2, 0]


def test_a_log_without_annotations_has_no_boxes_and_says_so(tmp_path: Path):
    write_log(tmp_path / "log", annotated=False)
    notes = import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    assert notes == ("no annotations in 1 of 1 log, so no boxes: log",)
    with pytest.raises(InputError, match="imported from argoverse2 without labels of objects"):
        Dataset.open(tmp_path / "out").check_labelled("objects")


PICTURE = f"sensors/cameras/ring_front_center/{START + 20_000_000}.jpg"
SWEEP = f"sensors/lidar/{START}.feather"
TABLES = ("city_SE3_egovehicle", "calibration/intrinsics", "calibration/egovehicle_SE3_sensor")
SENTENCES = {
    "missing": "no such file",
    "half": "not a Feather file, or a truncated one",
    "empty": "not a Feather file, or a truncated one",
    "columns": "no column",
}


@pytest.mark.parametrize(
    ("name", "how", "sentence"),
    [
        *((f"{name}.feather", how, SENTENCES[how]) for name in TABLES for how in SENTENCES),
        *((name, how, SENTENCES[how]) for name in ("annotations.feather", SWEEP) for how in list(SENTENCES)[1:]),
        (PICTURE, "half", "a truncated image"),
        (PICTURE, "empty", "not an image, or a truncated one"),
        (PICTURE, "dangling", "no such file"),
    ],
)
def test_a_file_of_a_log_names_itself(
    name: str, how: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    write_log(tmp_path / "log")
    path = tmp_path / "log" / name
    whole = path.read_bytes()
    path.unlink()
    if how in ("half", "empty"):
        path.write_bytes(whole[: len(whole) // 2] if how == "half" else b"")
    elif how == "columns":
        feather.write_feather(pa.table({"other": [1]}), path)
    elif how == "dangling":
        path.symlink_to(tmp_path / "nowhere.jpg")
    with pytest.raises(SystemExit) as ended:
        run(["import", "argoverse2", str(tmp_path / "log"), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-1].removeprefix("flcav: ").startswith(f"{path}: ")
    assert sentence in said[-1]
    assert not (tmp_path / "out").exists()


NO_QUATERNION = "the rotation of row 0 is no quaternion of length 1"
NO_NUMBER = "the column '{}' has no number in row 0, or one too large"


@pytest.mark.parametrize(
    ("name", "changed", "sentence"),
    [
        ("annotations.feather", {"length_m": -4.0}, "object 1 has a size that is not positive"),
        (
            "annotations.feather",
            {"qw": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0},
            NO_QUATERNION,
        ),
        ("annotations.feather", {"height_m": np.nan}, NO_NUMBER.format("height_m")),
        ("city_SE3_egovehicle.feather", {"tx_m": 1e300}, NO_NUMBER.format("tx_m")),
        ("calibration/intrinsics.feather", {"fx_px": 0.0}, "field 'fx' = 0.0"),
        (SWEEP, {"x": np.inf}, NO_NUMBER.format("x")),
    ],
)
def test_a_file_with_an_impossible_number_names_itself(
    name: str, changed: dict[str, float], sentence: str, tmp_path: Path
):
    write_log(tmp_path / "log")
    path = tmp_path / "log" / name
    table = feather.read_table(path, memory_map=False)
    for column, value in changed.items():
        table = table.set_column(table.column_names.index(column), column, pa.array([value] * len(table)))
    feather.write_feather(table, path)
    with pytest.raises(InputError, match=f"^{re.escape(f'{path}: {sentence}')}"):
        import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")


def test_a_log_that_nothing_is_annotated_in_has_no_boxes(tmp_path: Path):
    write_log(tmp_path / "log")
    path = tmp_path / "log" / "annotations.feather"
    feather.write_feather(feather.read_table(path, memory_map=False).slice(0, 0), path)
    far = tmp_path / "log" / "sensors" / "lidar" / f"{10**30}.feather"  # no time in nanoseconds
    far.write_bytes(b"")
    assert import_dataset("argoverse2", tmp_path / "log", tmp_path / "out") == (
        "no annotations in 1 of 1 log, so no boxes: log",
    )
    assert len(Dataset.open(tmp_path / "out")) == 2


def test_sweeps_and_pictures_that_are_not_there_are_told(tmp_path: Path):
    """Which files a log has, no file of it says: they are named by their times."""
    write_log(tmp_path / "log")
    (tmp_path / "log" / PICTURE).unlink()
    notes = import_dataset("argoverse2", tmp_path / "log", tmp_path / "dark")
    (note,) = notes
    told = r"no picture within 50 ms of a sweep, of cameras with others: 1, as of log/ring_front_center at \d+"
    assert re.fullmatch(told, note)
    (tmp_path / "log" / SWEEP).unlink()
    notes = import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    assert notes == ("no sweep at 1 annotated time, so no frames there: log/315966265000000000",)


def test_points_have_their_times(tmp_path: Path):
    write_log(tmp_path / "log")
    import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    times_s = Dataset.open(tmp_path / "out").frame(1).point_times["lidar"]
    np.testing.assert_allclose(times_s, (0, 0.05, 0.099), atol=1e-7)
    path = tmp_path / "log" / SWEEP
    columns = feather.read_table(path).to_pydict() | {"offset_ns": [0, 1, 10**9]}
    feather.write_feather(pa.table(columns), path)
    with pytest.raises(InputError, match="a point's 'offset_ns' is no time within the spin"):
        import_dataset("argoverse2", tmp_path / "log", tmp_path / "late")


def test_velocities_are_differences_of_neighbours():
    track = np.array(["b", "a", "a", "a", "c", "c"])
    time_s = np.array([0.0, 0.2, 0.0, 0.1, 0.0, 9.0])
    center = np.array([[9.0, 0, 0], [4, 2, 0], [0, 0, 0], [1, 2, 0], [0, 0, 0], [1, 0, 0]])
    expected = [[np.nan] * 3, [30, 0, 0], [10, 20, 0], [20, 10, 0], [np.nan] * 3, [np.nan] * 3]
    np.testing.assert_allclose(difference_tracks(track, time_s, center), expected)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real log of Argoverse 2 is not at {REAL}; set FLCAV_REAL_DATA")
def test_points_of_a_real_log_lie_in_its_boxes(tmp_path: Path):
    """Each box has as many points as `num_interior_pts` says, which Argoverse 2 counted; standing cars do not move."""
    import_dataset("argoverse2", REAL, tmp_path / "out")
    data = Dataset.open(tmp_path / "out")
    (log,) = REAL.iterdir()
    table = feather.read_table(log / "annotations.feather").to_pydict()
    said = dict(zip(zip(table["timestamp_ns"], table["track_uuid"]), table["num_interior_pts"]))
    sweeps = sorted(int(path.stem) for path in (log / "sensors" / "lidar").iterdir())
    assert len(data) == len(sweeps) == 2
    for i, sweep in enumerate(sweeps):
        truth = data.frame(i).annotations
        counted = np.array([said[sweep, track] for track in truth.track.tolist()])
        assert len(truth) == 81
        np.testing.assert_array_equal(truth.returns, counted)
    near = [data.frame(i) for i in range(2)]
    both = np.intersect1d(near[0].annotations.track, near[1].annotations.track)
    rows = [np.flatnonzero(np.isin(frame.annotations.track, both)) for frame in near]
    order = [rows[i][np.argsort(near[i].annotations.track[rows[i]])] for i in range(2)]
    moved = near[1].annotations.boxes.center[order[1]] - near[0].annotations.boxes.center[order[0]]
    assert all(0 < frame.point_times["lidar"].min() < 0.01 < 0.1 < frame.point_times["lidar"].max() for frame in near)
    assert validate(tmp_path / "out") == []
    step = near[1].time_s - near[0].time_s
    np.testing.assert_allclose(moved / step, near[0].annotations.velocity[order[0]], atol=1.5)
    lidar = transform_points(inverse(near[0].world_from_agent), near[0].world_from_sensor("lidar")[None, :3, 3])
    assert lidar[0, 2] == pytest.approx(1.97, abs=0.01)


def test_a_camera_of_argoverse_lies_in_its_log(tmp_path: Path):
    write_log(tmp_path / "folder" / "val" / "log")
    for table in ("intrinsics", "egovehicle_SE3_sensor"):
        path = tmp_path / "folder" / "val" / "log" / "calibration" / f"{table}.feather"
        read = feather.read_table(path)
        names = [name.replace("ring_front_center", "../../../elsewhere") for name in read["sensor_name"].to_pylist()]
        feather.write_feather(read.set_column(read.column_names.index("sensor_name"), "sensor_name", [names]), path)
    with pytest.raises(InputError, match=r"intrinsics.feather: '../../../elsewhere' is no name of a file in "):
        import_dataset("argoverse2", tmp_path / "folder", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def _write_logs(folder: Path, *, same: bool) -> None:
    """Write two logs of one name, in `val` and in `test`: of the same sweeps, or of others."""
    for split in ("val", "test"):
        write_log(folder / split / "one")
    if not same:
        for path in (folder / "test" / "one" / "sensors" / "lidar").iterdir():
            table = feather.read_table(path)
            x = table["x"].to_numpy() + np.float16(1)
            feather.write_feather(table.set_column(table.column_names.index("x"), "x", [x]), path)


@pytest.mark.parametrize("same", [True, False])
def test_logs_of_one_name_are_both_imported_and_told(same: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    _write_logs(tmp_path / "logs", same=same)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        run(["import", "argoverse2", str(tmp_path / "logs"), "--out", str(out)])
    assert ended.value.code == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "leakage" in line]
    data = Dataset.open(out)
    assert data.manifest.scenes == ["test-one", "val-one"]
    assert data.manifest.recipe["splits"] == {"test": ["test-one"], "val": ["val-one"]}
    assert len(data) == 4
    assert (
        said
        == [
            f"{out}: leakage, 'one' is in the splits 'test' and 'val', as the scenes test-one, val-one",
            f"{out} (split 'test') and {out} (split 'val'): leakage, they share 2 point clouds, the first is of the "
            "scenes 'test-one' and 'val-one'",
        ][: 1 + same]
    )
    assert validate(out) == said


def test_a_log_under_two_names_in_datasets_of_two_splits_is_a_leak(tmp_path: Path):
    write_log(tmp_path / "logs" / "train" / "one")
    write_log(tmp_path / "logs" / "val" / "other")
    for split in ("train", "val"):
        import_dataset("argoverse2", tmp_path / "logs", tmp_path / split, split=split)
        assert validate(tmp_path / split) == []
    train, val = tmp_path / "train", tmp_path / "val"
    assert find_leaks({str(each): Dataset.open(each).manifest for each in (train, val)}) == []
    assert find_copies([train, val, tmp_path / "nowhere"]) == [
        f"{train} (split 'train') and {val} (split 'val'): leakage, they share 2 point clouds, the first is of the "
        "scenes 'one' and 'other'"
    ]
    assert find_copies([train]) == []


def test_a_log_of_one_name_in_datasets_of_two_splits_is_a_leak(tmp_path: Path):
    _write_logs(tmp_path / "logs", same=False)
    for split in ("test", "val"):
        import_dataset("argoverse2", tmp_path / "logs", tmp_path / split, split=split)
    manifests = {split: Dataset.open(tmp_path / split).manifest for split in ("test", "val")}
    assert find_leaks(manifests) == [
        "test (split 'test') and val (split 'val'): leakage, they share 1 scene, the first is 'one'"
    ]


def test_a_log_that_is_linked_to_has_the_split_of_the_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_log(tmp_path / "store" / str(START))
    (tmp_path / "logs" / "val").mkdir(parents=True)
    (tmp_path / "logs" / "val" / "one").symlink_to(tmp_path / "store" / str(START))
    (tmp_path / "logs" / "val" / "inside").mkdir()
    monkeypatch.chdir(tmp_path / "logs" / "val" / "inside")
    for number, folder in enumerate((tmp_path / "logs", Path("../one"), Path("../../val/../val/one"))):
        import_dataset("argoverse2", folder, tmp_path / f"{number}", split="val")
        assert Dataset.open(tmp_path / f"{number}").manifest.recipe["splits"] == {"val": ["one"]}


@pytest.mark.parametrize("name", TABLES)
def test_a_sensor_or_a_pose_is_there_once(name: str, tmp_path: Path):
    write_log(tmp_path / "log")
    path = tmp_path / "log" / f"{name}.feather"
    table = feather.read_table(path)
    feather.write_feather(pa.concat_tables([table, table.slice(0, 1)]), path)
    with pytest.raises(InputError, match=r"feather: two rows with one '(timestamp_ns|sensor_name)'"):
        import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
