"""Logs of Argoverse 2: one written here with poses computed by hand, and a real one where there is one."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from flcav.config import InputError
from flcav.dataset.checks.validate import validate
from flcav.dataset.formats.importing import import_dataset
from flcav.dataset.formats.reading import difference_tracks
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "argoverse2"
START, STEP = 315_966_265_000_000_000, 100_000_000  # [ns]
SPEED = 5.0  # of the ego vehicle, north [m/s]; it heads north, and the car ahead of it stands
NORTH = Rotation.from_euler("z", 90, degrees=True)
UP_LIDAR = (1.35, 0.0, 1.64)


def _write(path: Path, **columns: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


def _placed(rotation: Rotation, places: np.ndarray) -> dict[str, Any]:
    x, y, z, w = np.broadcast_to(rotation.as_quat(), (len(places), 4)).T.tolist()
    columns = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict[str, Any](zip(columns, (w, x, y, z, *places.T.tolist()), strict=True))


def _write_log(folder: Path, *, annotated: bool = True) -> None:
    """Write two sweeps with a car 20 m ahead on the first, and a picture 20 ms after each."""
    sweeps = [START, START + STEP]
    times = [*sweeps, *(sweep + 20_000_000 for sweep in sweeps)]
    north = np.array([(time - START) / 1e9 * SPEED for time in times])
    places = np.column_stack((np.full(4, 100.0), 200 + north, np.full(4, 60.0)))
    _write(folder / "city_SE3_egovehicle.feather", timestamp_ns=times, **_placed(NORTH, places))
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    mounts = [_placed(Rotation.identity(), np.array([UP_LIDAR])), _placed(optical, np.array([[1.6, 0.0, 1.4]]))]
    both = {name: [*mounts[0][name], *mounts[1][name]] for name in mounts[0]}
    _write(
        folder / "calibration" / "egovehicle_SE3_sensor.feather", sensor_name=["up_lidar", "ring_front_center"], **both
    )
    lens = {"fx_px": [100.0], "fy_px": [100.0], "cx_px": [79.5], "cy_px": [47.5], "width_px": [160], "height_px": [96]}
    _write(folder / "calibration" / "intrinsics.feather", sensor_name=["ring_front_center"], **lens)
    for sweep, ahead in zip(sweeps, (20.0, 20.0 - SPEED * 0.1)):
        xyz = np.array([[ahead, 0.0, 0.5], [ahead + 1, 0.5, 0.2], [0.0, 9.0, -0.3]]).astype(np.float16)
        columns = dict(zip("xyz", xyz.T))
        path = folder / "sensors" / "lidar" / f"{sweep}.feather"
        _write(path, **columns, intensity=np.array([0, 51, 255], np.uint8))
        path = folder / "sensors" / "cameras" / "ring_front_center" / f"{sweep + 20_000_000}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (160, 96), (200, 30, 30)).save(path)
    if annotated:
        in_ego = np.array([[20.0, 0.0, 0.4], [20.0 - SPEED * 0.1, 0.0, 0.4], [5.0, 5.0, 0.0]])
        _write(
            folder / "annotations.feather",
            timestamp_ns=[*sweeps, sweeps[0]],
            track_uuid=["car", "car", "cone"],
            category=["REGULAR_VEHICLE", "REGULAR_VEHICLE", "CONSTRUCTION_CONE"],
            length_m=[4.0, 4.0, 0.4],
            width_m=[1.8, 1.8, 0.4],
            height_m=[1.5, 1.5, 0.7],
            **_placed(Rotation.from_euler("z", 180, degrees=True), in_ego),
        )


def test_a_log_is_imported_with_poses_boxes_and_linked_pictures(tmp_path: Path):
    log = tmp_path / "logs" / "val" / "one"
    _write_log(log)
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


def test_a_log_without_annotations_has_no_boxes_and_says_so(tmp_path: Path):
    _write_log(tmp_path / "log", annotated=False)
    notes = import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    assert notes == ("no annotations.feather in 1 of 1 logs, so no boxes",)
    with pytest.raises(InputError, match="imported from argoverse2 without labels of objects"):
        Dataset.open(tmp_path / "out").check_labelled("objects")


@pytest.mark.parametrize("how", ["missing", "truncated", "columns"])
@pytest.mark.parametrize(
    "name",
    ["city_SE3_egovehicle", "calibration/intrinsics", "calibration/egovehicle_SE3_sensor", f"sensors/lidar/{START}"],
)
def test_a_file_of_a_log_names_itself(name: str, how: str, tmp_path: Path):
    _write_log(tmp_path / "log")
    path = tmp_path / "log" / f"{name}.feather"
    if how == "missing":
        path.unlink()
        if "lidar" in name:
            return  # one sweep less
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        feather.write_feather(pa.table({"other": [1]}), path)
    sentence = {
        "missing": "no such file",
        "truncated": "not a Feather file, or a truncated one",
        "columns": "no column",
    }
    with pytest.raises(InputError, match=sentence[how]) as error:
        import_dataset("argoverse2", tmp_path / "log", tmp_path / "out")
    assert str(error.value).startswith(str(path))


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
        away = np.abs(truth.returns - counted)
        assert (away <= 0.05 * counted + 2).mean() > 0.95
    near = [data.frame(i) for i in range(2)]
    both = np.intersect1d(near[0].annotations.track, near[1].annotations.track)
    rows = [np.flatnonzero(np.isin(frame.annotations.track, both)) for frame in near]
    order = [rows[i][np.argsort(near[i].annotations.track[rows[i]])] for i in range(2)]
    moved = near[1].annotations.boxes.center[order[1]] - near[0].annotations.boxes.center[order[0]]
    step = near[1].time_s - near[0].time_s
    np.testing.assert_allclose(moved / step, near[0].annotations.velocity[order[0]], atol=1.5)
    lidar = transform_points(inverse(near[0].world_from_agent), near[0].world_from_sensor("lidar")[None, :3, 3])
    assert lidar[0, 2] == pytest.approx(1.97, abs=0.01)
