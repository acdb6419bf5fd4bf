"""Navigation logs on disk: read as written, mended and validated with their dataset, and refused where damaged."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.dataset.layout import navigation_path
from flcav.dataset.navigation_logs import SAMPLES, SCHEMA, load_logs, save_logs
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.tables import FILES_SCHEMA, write_rows
from flcav.dataset.validation import validate
from flcav.interface.progress import ignore_progress
from flcav.sensors.navigation import Gnss, Imu
from flcav.sensors.navigation_log import NavigationLog
from flcav.sources.recipe import Recipe
from flcav.storage.files import sha256, write_json

LIDAR = {"mount": {"z": 1.85}, "settings": {"channels": 4, "azimuth_steps": 90}}
RIG = {"lidars": {"lidar": LIDAR}, "gnss": {"gnss": {"mount": {"z": 1.6}}}, "imus": {"imu": {"mount": {"z": 0.5}}}}
RECIPE: dict[str, Any] = {
    "town": "ring",
    "seed": 3,
    "scenes": 2,
    "spins_per_scene": 2,
    "cavs": 2,
    "warmup_s": 12.0,
    "vehicle_rig": RIG,
}


def make_log(seconds: float = 2.0) -> NavigationLog:
    imu_s, fix_s = np.arange(0, seconds, 0.01), np.arange(0, seconds, 0.1)
    fix = np.column_stack((49 + 1e-5 * fix_s, np.full(len(fix_s), 8.4), np.zeros(len(fix_s))))
    inertia = np.column_stack((np.zeros((len(imu_s), 2)), np.full(len(imu_s), 9.8), np.zeros((len(imu_s), 3))))
    return NavigationLog("gnss", "imu", Gnss(noise_m=0.1), Imu(rate_hz=100.0), fix_s, fix, imu_s, inertia)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("logged") / "data"
    record(Recipe.model_validate(RECIPE | {"navigation_s": 5.0}), out, progress=ignore_progress)
    return out


def test_logs_are_read_as_they_were_written(tmp_path: Path) -> None:
    logs = {"cav0": make_log(), "cav10": make_log(3.0)}
    save_logs(logs, tmp_path / "a.parquet")
    save_logs(logs, tmp_path / "b.parquet")
    assert sha256(tmp_path / "a.parquet") == sha256(tmp_path / "b.parquet")
    read = load_logs(tmp_path / "a.parquet")
    assert list(read) == list(logs)
    for name, log in logs.items():
        own = read[name]
        assert (own.gnss, own.imu, own.receiver, own.unit) == (log.gnss, log.imu, log.receiver, log.unit)
        for samples in SAMPLES:
            np.testing.assert_array_equal(getattr(own, samples), getattr(log, samples))


def changed(values: np.ndarray, at: Any, value: float) -> np.ndarray:
    out = values.copy()
    out[at] = value
    return out


LOG = make_log()
DAMAGED = [
    ({"imu_time_s": changed(LOG.imu_time_s, 50, 0.2)}, r"IMU samples whose time runs backwards after 0.49 s"),
    ({"fix_time_s": changed(LOG.fix_time_s, 5, np.nan)}, "fixes that are not finite"),
    ({"inertia": changed(LOG.inertia, (7, 4), np.inf)}, "IMU samples that are not finite"),
    ({"inertia": changed(LOG.inertia, (7, 1), 9806.0)}, "reports a motion that nothing survives"),
    ({"inertia": changed(LOG.inertia, (7, 5), -30.0)}, "reports a motion that nothing survives"),
    ({"fix": changed(LOG.fix, (3, 0), 91.0)}, "fixes that are nowhere on Earth"),
    ({"fix": changed(LOG.fix, (3, 2), 1e9)}, "fixes that are nowhere on Earth"),
    ({"imu_time_s": LOG.imu_time_s[:50], "inertia": LOG.inertia[:40]}, "40 IMU samples at 50 times"),
    ({"fix_time_s": LOG.fix_time_s[:1], "fix": LOG.fix[:1]}, "1 fixes at 1 times; two or more are wanted"),
    ({"imu_time_s": LOG.imu_time_s + (LOG.imu_time_s > 1)}, r"no IMU samples for 1.01 s after 1.00 s"),
    ({"fix_time_s": LOG.fix_time_s * 60}, r"no fixes for 6.00 s after"),
    ({"inertia": LOG.inertia[:, :5]}, "an incomplete sample"),
]


@pytest.mark.parametrize(("changes", "sentence"), DAMAGED)
def test_damaged_logs_are_refused_in_a_sentence(changes: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    save_logs({"cav3": replace(LOG, **changes)}, tmp_path / "s.parquet")
    with pytest.raises(InputError, match=rf"s\.parquet: the log of 'cav3' .*{sentence}"):
        load_logs(tmp_path / "s.parquet")


def test_files_that_hold_no_logs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    with pytest.raises(InputError, match=r"s\.parquet: no such file"):
        load_logs(path)
    path.write_bytes(b"PAR1 but no more")
    with pytest.raises(InputError, match=r"s\.parquet: not a readable Parquet file"):
        load_logs(path)
    pq.write_table(pa.table({"agent": ["cav0"]}), path)
    with pytest.raises(InputError, match=r"s\.parquet: not the navigation logs of a scene"):
        load_logs(path)
    save_logs({"cav0": LOG}, path)
    table, place = pq.read_table(path), SCHEMA.get_field_index("unit")
    for text, sentence in (
        ("{", "a data sheet that is no JSON"),
        ('{"rate_hz": -1}', "field 'rate_hz' = -1"),
        ("[]", ""),
    ):
        pq.write_table(table.set_column(place, SCHEMA.field(place), pa.array([text])), path)
        with pytest.raises(InputError, match=rf"s\.parquet: the log of 'cav0'.*{sentence}"):
            load_logs(path)
    pq.write_table(table.set_column(place, SCHEMA.field(place), pa.array([None], pa.string())), path)
    with pytest.raises(InputError, match="without empty cells"):
        load_logs(path)


def test_a_recording_has_the_log_of_each_drive_and_else_the_bytes_of_one_without(
    recorded: Path, tmp_path: Path
) -> None:
    data = Dataset.open(recorded)
    assert validate(recorded, progress=ignore_progress) == []
    for scene in data.manifest.scenes:
        logs = data.navigation_logs(scene)
        assert list(logs) == ["cav0", "cav1"]
        for log in logs.values():
            np.testing.assert_allclose(log.imu_time_s, np.arange(700, 1301) / 100, atol=1e-9)
            np.testing.assert_allclose(log.fix_time_s, np.arange(70, 131) / 10, atol=1e-9)
    plain = tmp_path / "plain"
    record(Recipe.model_validate(RECIPE), plain, progress=ignore_progress)
    assert Dataset.open(plain).navigation_logs("ring-3-000") == {}
    assert "navigation_s" not in (plain / "manifest.json").read_text()
    for path in plain.rglob("*"):
        if path.is_file() and path.name not in ("manifest.json", "files.parquet"):
            assert sha256(path) == sha256(recorded / path.relative_to(plain)), path


@pytest.mark.slow
def test_workers_write_the_same_logs_and_a_lost_one_is_recorded_again(recorded: Path, tmp_path: Path) -> None:
    recipe, out = Recipe.model_validate(RECIPE | {"navigation_s": 5.0}), tmp_path / "data"
    record(recipe, out, jobs=2, progress=ignore_progress)
    path, held = out / navigation_path("ring-3-001"), recorded / navigation_path("ring-3-001")
    assert sha256(path) == sha256(held)
    path.unlink()
    assert validate(out, progress=ignore_progress) == [f"{path}: missing"]
    assert record(recipe, out, progress=ignore_progress)
    assert sha256(path) == sha256(held)


def test_validate_tells_of_logs_that_end_before_their_frames(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    shutil.copytree(recorded, out)
    path = out / navigation_path("ring-3-000")
    logs = load_logs(path)
    log = logs["cav1"]
    logs["cav1"] = replace(log, imu_time_s=log.imu_time_s[:-5], inertia=log.inertia[:-5])
    save_logs(logs, path)
    assert len(validate(out, progress=ignore_progress)) == 1  # of a file that was altered nothing else is told
    files = pq.read_table(out / "files.parquet").to_pylist()
    row = next(row for row in files if row["path"] == navigation_path("ring-3-000"))
    row |= {"bytes": path.stat().st_size, "sha256": sha256(path)}
    write_rows(pa.Table.from_pylist(files, schema=FILES_SCHEMA), out / "files.parquet")
    manifest = json.loads((out / "manifest.json").read_text())
    listing = out / "files.parquet"
    manifest["tables"]["files.parquet"] = {"bytes": listing.stat().st_size, "sha256": sha256(listing)}
    write_json(out / "manifest.json", manifest)
    (problem,) = validate(out, progress=ignore_progress)
    assert problem == f"{path}: the log of 'cav1' goes from 7.0 to 12.9 s, its frames from 12.0 to 13.0 s"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"vehicle_rig": "lidar32"}, "navigation_s: the vehicles need a GNSS receiver and an IMU"),
        ({"vehicle_rig": RIG | {"imus": {"imu": {"settings": {"rate_hz": 5.0}}}}}, "an IMU of 5 Hz is too slow"),
        ({"navigation_s": -1.0}, "navigation_s"),
        ({"navigation_s": 0.25}, "must be a multiple of 0.1 s"),
    ],
)
def test_recipes_that_cannot_log_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Recipe.model_validate(RECIPE | {"navigation_s": 5.0} | changes)
