"""A small recording of the built-in simulator, damaged in every way that `validate` knows."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.dataset.layout import FrameKey, Manifest
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.tables import FILES_SCHEMA, write_rows
from flcav.dataset.validation import check_order, find_leaks, validate
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import sha256, write_json

RIG = {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 20, "azimuth_steps": 450}}}}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "data"
    fields = {"town": "suburb", "seed": 5, "cavs": 2, "poles": [1], "spins_per_scene": 2, "scenes": 2, "every_s": 2.0}
    record(
        EmbeddedSource(Recipe.model_validate({**fields, "warmup_s": 40.0, "vehicle_rig": RIG, "pole_rig": RIG})), out
    )
    return out


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "data"))


def resign(folder: Path, drop: str | None = None) -> None:
    """Make the manifest say that the folder is as it should be; without the file `drop`."""
    manifest = json.loads((folder / "manifest.json").read_text())
    files = pq.read_table(folder / "files.parquet").to_pylist()
    if drop is not None:
        (folder / drop).unlink()
        files = [entry for entry in files if entry["path"] != drop]
    for entry in files:
        path = folder / entry["path"]
        entry |= {"bytes": path.stat().st_size, "sha256": sha256(path)}
    write_rows(pa.Table.from_pylist(files, schema=FILES_SCHEMA), folder / "files.parquet")
    for name, entry in manifest["tables"].items():
        entry |= {"bytes": (folder / name).stat().st_size, "sha256": sha256(folder / name)}
    write_json(folder / "manifest.json", manifest)


def change(folder: Path, table: str, column: str, row: int, value: Any) -> None:
    """Change one cell of a table, and the manifest with it."""
    path = folder / f"{table}.parquet"
    rows = pq.read_table(path)
    cells = rows[column].to_pylist()
    cells[row] = value(cells[row]) if callable(value) else value
    position = rows.schema.get_field_index(column)
    write_rows(
        rows.set_column(position, rows.schema.field(column), pa.array(cells, rows.schema.field(column).type)), path
    )
    resign(folder)


def best_seen(folder: Path) -> int:
    """Return the annotation row with the most returns."""
    return int(np.argmax(pq.read_table(folder / "annotations.parquet")["returns"].to_numpy()))


def first_cloud(folder: Path) -> Path:
    return folder / "lidar" / "suburb-5-000_0000_cav0.bin"


def only(problems: list[str]) -> str:
    assert len(problems) == 1, problems
    return problems[0]


def test_a_recording_has_no_problems(recorded: Path):
    assert validate(recorded) == []
    assert len(Dataset.open(recorded)) == 12


@pytest.mark.parametrize(
    "name", ["lidar/suburb-5-000_0000_cav0.bin", "traces/suburb-5-001.parquet", "calibration.json", "poses.parquet"]
)
def test_a_missing_file(folder: Path, name: str):
    (folder / name).unlink()
    assert validate(folder)[0] == f"{folder / name}: missing"


def test_a_truncated_point_cloud(folder: Path):
    cloud = first_cloud(folder)
    cloud.write_bytes(cloud.read_bytes()[:-16])
    assert only(validate(folder)).startswith(f"{cloud}: truncated")


@pytest.mark.parametrize("name", ["lidar/suburb-5-000_0000_cav0.bin", "traces/suburb-5-001.parquet"])
def test_an_altered_file(folder: Path, name: str):
    data = bytearray((folder / name).read_bytes())
    data[100] ^= 1
    (folder / name).write_bytes(data)
    assert validate(folder)[0].startswith(f"{folder / name}: altered")


def test_an_extra_file(folder: Path):
    (folder / "lidar" / "notes.txt").touch()
    assert only(validate(folder)) == f"{folder / 'lidar' / 'notes.txt'}: not part of the dataset"


def test_unreadable_tables_are_named(folder: Path):
    (folder / "annotations.parquet").write_bytes(b"PAR1")
    resign(folder)
    assert "annotations.parquet: not a readable Parquet file" in only(validate(folder))


@pytest.mark.parametrize("column", ["x", "y", "z"])
@pytest.mark.parametrize("step_m", [-1.0, 1.0, 0.01])
def test_a_moved_box_is_found_by_the_traffic(folder: Path, column: str, step_m: float):
    change(folder, "annotations", column, best_seen(folder), lambda value: value + step_m)
    problems = [problem for problem in validate(folder) if "not what the traffic has" in problem]
    assert f"{abs(step_m):.2f} m away" in only(problems)


@pytest.mark.parametrize("column", ["x", "y"])
def test_a_moved_box_is_found_by_its_points(folder: Path, column: str):
    row = best_seen(folder)
    scene = pq.read_table(folder / "annotations.parquet")["frame"][row].as_py().split("_")[0]
    resign(folder, drop=f"traces/{scene}.parquet")
    change(folder, "annotations", column, row, lambda value: value + 1.0)
    forward = validate(folder)
    change(folder, "annotations", column, row, lambda value: value - 2.0)
    backward = validate(folder)
    assert any("points lie outside the box" in problem for problem in forward + backward)


def test_more_returns_than_points(folder: Path):
    change(folder, "annotations", "returns", best_seen(folder), lambda value: 2 * value)
    assert "points lie outside the box" in only(validate(folder))


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("annotations", "category", "Car", "unknown class 'Car'"),
        ("annotations", "category", "bus", "is annotated as bus, it is a"),
        ("annotations", "x", float("nan"), "not finite"),
        ("annotations", "y", 1e300, r"a number beyond 1e\+09"),
        ("annotations", "vx", lambda value: value + 1, "speed 1.00 m/s different"),
        ("annotations", "length", 0.0, "no volume"),
        ("annotations", "occlusion", 1.5, "occlusion outside 0 to 1"),
        ("annotations", "returns", -1, "negative returns"),
        ("annotations", "track", "veh999", "annotated but not in town"),
        ("annotations", "track", "cav0", "annotated in its own frame"),
        ("annotations", "frame", "elsewhere", "rows are not those of the frames"),
        ("frames", "time_s", 3.0, "time runs backward|does not go with"),
        ("frames", "index", 7, "time runs backward|does not go with"),
        ("frames", "agent", "cav1", "recorded more than once"),
        ("frames", "points", lambda value: [value[0] + 1], r"cav0\.bin: \d+ bytes where"),
        ("frames", "annotations", lambda value: value - 1, "rows are not those of the frames"),
        ("poses", "world_from_agent", lambda value: [2 * number for number in value], "not a rigid transform"),
        ("poses", "world_from_agent", lambda value: [*value[:3], value[3] + 1, *value[4:]], "cav0 is 1.00 m from"),
    ],
)
def test_a_wrong_cell(folder: Path, table: str, column: str, value: Any, message: str):
    change(folder, table, column, 0, value)
    assert any(re.search(message, problem) for problem in validate(folder))


SIGNALLING = np.array([0x7F800001], np.uint32).view(np.float32)[0]  # a NaN whose conversion numpy warns of


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("column", "value"), [(0, np.nan), (1, SIGNALLING), (2, np.inf), (3, 1.5)])
def test_a_wrong_point(folder: Path, column: int, value: float):
    cloud = first_cloud(folder)
    points = np.fromfile(cloud, "<f4").reshape(-1, 4)
    points[7, column : column + 1].view(np.uint32)[:] = np.asarray([value], np.float32).view(np.uint32)
    points.tofile(cloud)
    resign(folder)
    assert any("not finite" in problem or "intensity outside" in problem for problem in validate(folder))


def test_an_unfinished_folder_is_no_dataset(folder: Path):
    (folder / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"manifest\.json: missing"):
        validate(folder)


def test_a_calibration_error_that_is_none(folder: Path):
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["recipe"]["calibration_error"] = {"position_m": "much"}
    write_json(folder / "manifest.json", manifest)
    with pytest.raises(InputError, match="calibration_error of the recipe: field 'position_m' = 'much'"):
        validate(folder)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda manifest: None, None),
        (lambda manifest: manifest["recipe"].update(split="test"), "they share 2 scenes, the first is 'suburb-5-000'"),
        (
            lambda manifest: manifest.update(recipe=manifest["recipe"] | {"split": "test"}, scenes=["suburb-5-002"]),
            "they share the traffic seed 5 in 'suburb'",
        ),
        (
            lambda manifest: manifest.update(recipe=manifest["recipe"] | {"split": "test", "seed": 6}, scenes=["x"]),
            None,
        ),
    ],
)
def test_leakage_between_splits(recorded: Path, edit: Callable[[dict], None], message: str | None):
    manifest = json.loads((recorded / "manifest.json").read_text())
    other = json.loads((recorded / "manifest.json").read_text())
    edit(other)
    found = find_leaks({"one": Manifest.model_validate(manifest), "two": Manifest.model_validate(other)})
    assert found == [] if message is None else message in only(found)


def test_order_of_time():
    def key(index: int, agent: str, time_s: float) -> FrameKey:
        return FrameKey("a", index, agent, time_s)

    good = [key(0, "cav0", 1.0), key(0, "cav1", 1.0), key(1, "cav0", 1.5), FrameKey("b", 0, "cav0", 1.0)]
    assert check_order(good) == []
    assert "backward" in only(check_order([key(1, "cav0", 1.0), key(2, "cav0", 0.9)]))
    assert "does not go with" in only(check_order([key(1, "cav0", 1.0), key(2, "cav0", 1.0)]))
    assert "more than once" in only(check_order([key(1, "cav0", 1.0), key(1, "cav0", 1.0)]))
