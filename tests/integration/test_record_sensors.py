"""A small recording of every kind of sensor: read back, and damaged in ways that `validate` knows."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from flcav.config import InputError
from flcav.dataset.formats.sweeps import read_cloud_file
from flcav.dataset.layout import payload_path
from flcav.dataset.payloads import POINTS
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.tables import FILES_SCHEMA, write_rows
from flcav.dataset.validation import validate
from flcav.sensors.frame import Frame
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import sha256, write_json

RIG = {
    "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 16, "azimuth_steps": 360}}},
    "cameras": {
        "front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 160, "height": 96}, "trigger_ms": 30.0},
        "wide": {
            "mount": {"z": 1.6, "yaw_deg": 120},
            "settings": {"width": 160, "height": 96, "fov_deg": 80, "k1": -0.08},
        },
    },
    "infrareds": {"warm": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 96, "height": 64}}},
    "radars": {"radar": {"mount": {"x": 2.2, "z": 0.5}}},
    "gnss": {"gnss": {"mount": {"z": 1.6}}},
    "imus": {"imu": {"mount": {"z": 0.5}}},
}
RECIPE = {
    "town": "grid",
    "seed": 21,
    "cavs": 2,
    "poles": [3],
    "warmup_s": 40.0,
    "spins_per_scene": 2,
    "vehicle_rig": RIG,
    "weather": [{"at_s": 0, "weather": "clear"}, {"at_s": 1, "weather": "light_rain"}],
    "calibration_error": {"position_m": 0.05, "rotation_deg": 0.5, "focal_px": 1.0, "time_ms": 2.0},
}


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    source = EmbeddedSource(Recipe.model_validate(RECIPE))
    return list(source.frames(source.scenes()[0]))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "data"
    record(EmbeddedSource(Recipe.model_validate(RECIPE)), out)
    return out


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "data"))


def test_a_recorded_sweep_is_read_as_a_file(recorded: Path):
    data = Dataset.open(recorded)
    for number in range(len(data)):
        for name in data.lidars(number):
            path = recorded / payload_path(name, data.name(number), POINTS)
            np.testing.assert_array_equal(read_cloud_file(path), data.frame(number).lidar[name])


def resign(folder: Path) -> None:
    """Make the listing and the manifest say that the folder is as it should be."""
    files = pq.read_table(folder / "files.parquet").to_pylist()
    for entry in files:
        entry |= {"bytes": (folder / entry["path"]).stat().st_size, "sha256": sha256(folder / entry["path"])}
    write_rows(pa.Table.from_pylist(files, schema=FILES_SCHEMA), folder / "files.parquet")
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, entry in manifest["tables"].items():
        entry |= {"bytes": (folder / name).stat().st_size, "sha256": sha256(folder / name)}
    write_json(folder / "manifest.json", manifest)


def equal(one: Any, other: Any) -> None:
    """Assert that two parts of frames are the same, bit for bit."""
    assert set(one) == set(other)
    for name in one:
        if isinstance(one[name], np.ndarray):
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
        elif isinstance(one[name], float | int | str):
            assert one[name] == other[name]
        elif isinstance(one[name], dict):
            equal(one[name], other[name])
        else:
            equal(vars(one[name]), vars(other[name]))


def test_every_sensor_comes_back(recorded: Path, frames: list[Frame]):
    dataset = Dataset.open(recorded)
    assert [dataset.name(i) for i in range(len(dataset))] == [frame.key for frame in frames]
    for i, frame in enumerate(frames):
        stored = dataset.frame(i)
        for part in ("lidar", "radar", "infrared", "gnss", "imu", "agent_at_trigger"):
            equal(getattr(frame, part), getattr(stored, part))
        for part in ("calibration", "assumed"):
            equal(vars(getattr(frame, part)), vars(getattr(stored, part)))
        for part in ("points", "views", "signs"):
            equal(getattr(frame.annotations, part), getattr(stored.annotations, part))
        np.testing.assert_array_equal(frame.annotations.acceleration, stored.annotations.acceleration)
        assert stored.weather == frame.weather
        assert set(stored.images) == set(frame.images)
        for name, image in frame.images.items():
            for plane in ("rgb", "semantic", "instance"):
                np.testing.assert_array_equal(getattr(stored.images[name], plane), getattr(image, plane))
            depth = stored.images[name].depth_m
            assert depth is not None
            assert image.depth_m is not None
            np.testing.assert_allclose(depth, image.depth_m, rtol=2.0**-15)
            np.testing.assert_array_equal(dataset.plane(i, name, "rgb"), image.rgb)


def test_the_assumed_calibration_is_wrong_and_the_true_one_is_not(recorded: Path):
    frame = Dataset.open(recorded).frame(0)
    assert not np.allclose(frame.assumed.agent_from_sensor["front"], frame.calibration.agent_from_sensor["front"])
    assert frame.calibration.offset_ms["front"] == 30.0 != frame.assumed.offset_ms["front"]


def test_the_weather_changes(recorded: Path):
    dataset = Dataset.open(recorded)
    first, last = dataset.frame(0).weather, dataset.frame(len(dataset) - 1).weather
    assert first is not None
    assert last is not None
    assert first.rain_mm_h == 0 < last.rain_mm_h


def test_a_recording_of_every_sensor_has_no_problems(recorded: Path):
    assert validate(recorded) == []


def image_file(folder: Path, suffix: str) -> Path:
    return folder / "front" / f"grid-21-000_0000_cav0.{suffix}"


def test_images_are_read_when_asked_for(folder: Path):
    image_file(folder, "webp").unlink()
    frame = Dataset.open(folder).frame(0)
    assert frame.images["wide"].rgb.shape == (96, 160, 3)
    with pytest.raises(InputError, match=r"front/grid-21-000_0000_cav0\.webp: missing from the dataset"):
        _ = frame.images["front"].rgb
    assert validate(folder) == [f"{image_file(folder, 'webp')}: missing"]


def test_a_shifted_instance_image(folder: Path):
    path = image_file(folder, "instance.png")
    pixels = np.roll(np.asarray(Image.open(path)), 30, axis=1)
    Image.fromarray(pixels).save(path)
    resign(folder)
    assert any("is not around its pixels" in problem for problem in validate(folder))
    assert any("lie outside its box" in problem for problem in validate(folder))


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("views", "pixels", lambda value: value + 1, "shows \\d+ pixels of"),
        ("views", "occlusion", 1.5, "outside 0 to 1"),
        ("views", "visible_x1", lambda value: value - 3, "is not around its pixels"),
        ("views", "sensor", "nowhere", "no amodal box|not \\d+"),
        ("signs", "state", "purple", "unknown state"),
        ("signs", "x2", 1e4, "does not lie in the image"),
        ("signs", "y1", float("nan"), "sign whose box has no area"),
        ("signs", "distance_m", float("inf"), "at no distance"),
        ("gnss", "latitude_deg", 123.0, "nowhere on Earth"),
        ("imu", "force_x", 1e6, "nothing survives"),
        ("weather", "cloud_cover", 2.0, "cloud_cover"),
    ],
)
def test_a_wrong_cell(folder: Path, table: str, column: str, value: Any, message: str):
    path = folder / f"{table}.parquet"
    rows = pq.read_table(path)
    cells = rows[column].to_pylist()
    row = int(np.argmax(rows["pixels"].to_numpy())) if "pixels" in rows.column_names else 0
    cells[row] = value(cells[row]) if callable(value) else value
    at = rows.schema.get_field_index(column)
    write_rows(rows.set_column(at, rows.schema.field(column), pa.array(cells, rows.schema.field(column).type)), path)
    resign(folder)
    assert any(re.search(message, problem) for problem in validate(folder))


def test_a_sign_without_a_box_is_refused_by_whoever_reads_its_frame(folder: Path):
    rows = pq.read_table(folder / "signs.parquet")
    at = rows.schema.get_field_index("x1")
    none = pa.array([float("nan")] * len(rows), rows.schema.field(at).type)
    write_rows(rows.set_column(at, rows.schema.field(at), none), folder / "signs.parquet")
    data = Dataset.open(folder)
    with pytest.raises(InputError, match="a sign whose box has no area"):
        data.frame(data.number(rows["frame"][0].as_py()))


def test_pixels_of_who_is_not_in_the_image(folder: Path):
    rows = pq.read_table(folder / "views.parquet")
    pixels = rows["pixels"].to_numpy()
    claimed = pa.array(np.where(pixels == 0, 10_000, pixels), rows.schema.field("pixels").type)
    at = rows.schema.get_field_index("pixels")
    write_rows(rows.set_column(at, rows.schema.field(at), claimed), folder / "views.parquet")
    resign(folder)
    assert any("shows 0 pixels of" in problem for problem in validate(folder))


@pytest.mark.parametrize(
    ("which", "field", "change", "message"),
    [
        (
            "true",
            "agent_from_sensor",
            lambda v: [*v[:2], 2 * v[2], *v[3:]],
            "mount of 'front' is not a rigid transform",
        ),
        ("true", "intrinsics", lambda v: [-v[0], *v[1:]], "intrinsics of 'front' are not those of a camera"),
        ("assumed", "agent_from_sensor", lambda v: [*v[:3], v[3] + 2, *v[4:]], "off by position_m"),
        ("assumed", "offset_ms", lambda v: v + 50, "off by time_ms"),
    ],
)
def test_a_wrong_calibration(folder: Path, which: str, field: str, change: Any, message: str):
    path = folder / "calibration.json"
    values = json.loads(path.read_text())
    sensor = values["cav0"][which]["front"]
    sensor[field] = change(sensor[field])
    write_json(path, values)
    resign(folder)
    assert any(message in problem for problem in validate(folder))


def test_half_a_sweep(folder: Path):
    cloud = folder / "lidar" / "grid-21-000_0000_cav0.bin"
    points = np.fromfile(cloud, "<f4").reshape(-1, 4)
    ahead = np.abs(points[:, 1]) < points[:, 0]
    points[ahead, :2] *= -1
    points.tofile(cloud)
    resign(folder)
    assert any("is no whole spin" in problem for problem in validate(folder))


@pytest.mark.parametrize(("number", "advice"), [(1, "record it again"), (4, "update flcav")])
def test_a_dataset_of_another_version(folder: Path, number: int, advice: str):
    (folder / "manifest.json").write_text(json.dumps({"format": number}))
    with pytest.raises(InputError, match=f"format {number}, this version of flcav reads formats 2 and 3; {advice}"):
        validate(folder)
