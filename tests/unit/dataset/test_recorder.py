import errno
import hashlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import toy_source
from toy_source import ToySource

from flcav.config import InputError
from flcav.dataset import layout
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.storage import files


def digests(folder: Path) -> dict[str, str]:
    """Return every file below `folder`, hidden ones too, with its hash."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("whole") / "data"
    assert record(ToySource(), out)
    return digests(out)


@pytest.mark.slow
def test_same_seed_same_bytes_whatever_the_jobs(tmp_path: Path, uninterrupted: dict[str, str]):
    counts = []
    record(ToySource(), tmp_path / "data", jobs=2, progress=lambda done, total, note: counts.append((done, total)))
    assert digests(tmp_path / "data") == uninterrupted
    assert counts[-1] == (12, 12)
    assert not multiprocessing.active_children()


def test_another_seed_gives_other_frames(tmp_path: Path, uninterrupted: dict[str, str]):
    record(ToySource(seed=1), tmp_path / "data")
    assert digests(tmp_path / "data").keys() - uninterrupted.keys()


def test_the_manifest_lists_every_file_and_no_surroundings(tmp_path: Path):
    record(ToySource(), tmp_path / "data")
    manifest = Dataset.open(tmp_path / "data").manifest
    found = digests(tmp_path / "data")
    del found["manifest.json"]
    files = pq.read_table(tmp_path / "data" / "files.parquet").to_pydict()
    listed = {name: entry.sha256 for name, entry in manifest.tables.items()}
    assert listed | dict(zip(files["path"], files["sha256"])) == found
    counts = {"scenes": 2, "frames": 12, "annotations": 48, "points": 12 * 125, "images": 0}
    assert manifest.counts.model_dump() == counts | {"payload_bytes": 12 * 125 * 16}
    assert manifest.recipe == ToySource().describe()
    assert str(tmp_path) not in (tmp_path / "data" / "manifest.json").read_text()


def test_a_finished_recording_is_left_alone(tmp_path: Path):
    assert record(ToySource(), tmp_path / "data")
    before = digests(tmp_path / "data")
    assert not record(ToySource(), tmp_path / "data")
    assert digests(tmp_path / "data") == before


def test_a_lock_in_the_folder_is_no_other_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uninterrupted: dict[str, str]
):
    monkeypatch.setattr(os, "access", lambda path, how: path != tmp_path)
    assert record(ToySource(), tmp_path / "data")
    assert digests(tmp_path / "data") == uninterrupted


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def alter(path: Path) -> None:
    path.write_bytes(b"\0" * path.stat().st_size)


@pytest.mark.parametrize("damage", [Path.unlink, cut, alter])
@pytest.mark.parametrize("file", ["lidar/toy-0-001_0002_pole3.bin", "frames.parquet", "files.parquet"])
def test_a_damaged_dataset_is_mended(
    tmp_path: Path, damage: Callable[[Path], None], file: str, uninterrupted: dict[str, str]
):
    data, told = tmp_path / "data", []
    record(ToySource(), data)
    other = data / "lidar/toy-0-000_0000_cav0.bin"
    before = other.stat()
    damage(data / file)
    if damage is alter and file.endswith(".bin"):
        assert not record(ToySource(), data)  # its size is right: `flcav validate` compares hashes
        return
    assert record(ToySource(), data, progress=lambda done, total, note: told.append(note))
    assert digests(data) == uninterrupted
    assert not record(ToySource(), data)
    if file.endswith(".bin"):
        assert told[0] == f"{data / file} is damaged, recorded anew"
        assert (other.stat().st_ino, other.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_a_file_that_is_lost_while_parts_are_joined_is_recorded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uninterrupted: dict[str, str]
):
    from flcav.dataset.recording import recorder

    assemble = recorder._assemble

    def lose(source: ToySource, out: Path, header: Any) -> None:
        next((out / layout.WORK).rglob("*_pole3.bin")).unlink()
        assemble(source, out, header)

    monkeypatch.setattr(recorder, "_assemble", lose)
    record(ToySource(), tmp_path / "data")
    assert digests(tmp_path / "data") == uninterrupted


def test_a_dataset_that_is_recorded_otherwise_now_is_not_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    record(ToySource(), tmp_path / "data")
    path = tmp_path / "data/lidar/toy-0-001_0002_pole3.bin"
    path.unlink()
    monkeypatch.setattr(toy_source, "MOUNT", pose(0.2, 0.0, 1.8, yaw=0.01))
    with pytest.raises(InputError, match=rf"{path}: damaged, and not recorded as it was; remove .*data to record it"):
        record(ToySource(), tmp_path / "data")
    assert not path.exists()


def test_what_is_complete_is_on_the_disk_before_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    events: list[Path] = []
    flush, replace, rename = files._flush, Path.replace, Path.rename
    monkeypatch.setattr(files, "_flush", lambda path: (events.append(path), flush(path)))
    monkeypatch.setattr(Path, "replace", lambda path, to: (events.append(to), replace(path, to))[1])
    monkeypatch.setattr(Path, "rename", lambda path, to: (events.append(to), rename(path, to))[1])
    record(ToySource(scene_count=1), tmp_path / "data")
    part = tmp_path / "data" / layout.WORK / "toy-0-000" / "00000"
    payload = part.with_suffix(".part") / "payloads/lidar/toy-0-000_0002_pole3.bin"
    assert events.index(payload) < events.index(part) < events.index(tmp_path / "data/lidar") < len(events) - 2
    assert events[-2:] == [tmp_path / "data/manifest.json", tmp_path / "data"]


def test_another_recipe_is_refused_by_name(tmp_path: Path):
    record(ToySource(), tmp_path / "data")
    with pytest.raises(InputError, match=r"holds another dataset \(different: seed, spins_per_scene\)"):
        record(ToySource(seed=1, spins=4), tmp_path / "data")
    (tmp_path / "data" / "manifest.json").unlink()
    with pytest.raises(InputError, match="holds other files"):
        record(ToySource(), tmp_path / "data")


def test_another_recipe_cannot_finish_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(OSError, match="No space left"):
        record(ToySource(fail_at=1), tmp_path / "data")
    with pytest.raises(InputError, match=r"unfinished recording of another \(different: seed\)"):
        record(ToySource(seed=1), tmp_path / "data")
    monkeypatch.setattr("flcav.dataset.recording.recorder.package_versions", lambda: {"numpy": "0.1"})
    with pytest.raises(InputError, match=r"different: embreex, flcav, libsumo"):
        record(ToySource(), tmp_path / "data")


def test_a_folder_of_other_things_is_refused(tmp_path: Path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="holds other files"):
        record(ToySource(), tmp_path)
    with pytest.raises(InputError, match="is a file"):
        record(ToySource(), tmp_path / "letter.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_full_disk_leaves_nothing_half_written(tmp_path: Path, jobs: int, uninterrupted: dict[str, str]):
    with pytest.raises(OSError, match="No space left on device"):
        record(ToySource(fail_at=1), tmp_path / "data", jobs=jobs)
    assert [path.name for path in (tmp_path / "data").iterdir()] == [layout.WORK]
    with pytest.raises(InputError, match="unfinished"):
        Dataset.open(tmp_path / "data")
    record(ToySource(), tmp_path / "data", jobs=jobs)
    assert digests(tmp_path / "data") == uninterrupted


@pytest.mark.parametrize("last", range(0, 17, 4))
def test_an_interruption_while_files_move_is_made_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uninterrupted: dict[str, str], last: int
):
    from flcav.dataset.recording import recorder

    assert last < len(uninterrupted)
    move, moved = recorder._move, []

    def failing(source: Path, target: Path) -> None:
        if len(moved) == last:
            raise OSError(errno.ENOSPC, "No space left on device")
        moved.append(target)
        move(source, target)

    monkeypatch.setattr(recorder, "_move", failing)
    with pytest.raises(OSError, match="No space left"):
        record(ToySource(), tmp_path / "data")
    monkeypatch.setattr(recorder, "_move", move)
    record(ToySource(), tmp_path / "data")
    assert digests(tmp_path / "data") == uninterrupted


@pytest.mark.slow
@pytest.mark.parametrize(("jobs", "number"), [(1, signal.SIGKILL), (2, signal.SIGKILL), (2, signal.SIGINT)])
def test_a_killed_recording_is_finished_by_the_same_command(
    tmp_path: Path, jobs: int, number: int, uninterrupted: dict[str, str]
):
    out = tmp_path / "data"
    script = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
if __name__ == "__main__":
    from pathlib import Path
    from flcav.dataset.recording.recorder import record
    from toy_source import ToySource
    record(ToySource(pause_s=0.3), Path({str(out)!r}), jobs={jobs})
"""
    (tmp_path / "run.py").write_text(script)
    process = subprocess.Popen([sys.executable, tmp_path / "run.py"], stderr=subprocess.DEVNULL, start_new_session=True)
    while not list(out.glob(f"{layout.WORK}/*/*/payloads/lidar/*.bin")):
        assert process.poll() is None
        time.sleep(0.02)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as the terminal does
    else:
        process.send_signal(number)
    assert process.wait(10) != 0
    deadline = time.monotonic() + 10
    while group_lives(process.pid):
        assert time.monotonic() < deadline, "a worker outlived the recording"
        time.sleep(0.02)
    assert not (out / "manifest.json").exists()
    record(ToySource(), out)
    assert digests(out) == uninterrupted


def test_a_worker_killed_for_memory_is_said(tmp_path: Path):
    with pytest.raises(OSError, match="a worker was killed"):
        record(ToySource(die=True), tmp_path / "data", jobs=2)


def group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_folder_that_cannot_be_made(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError):
        record(ToySource(), tmp_path / "file" / "data")


def test_two_scenes_of_one_name_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ToySource, "scenes", lambda self: ["a", "b", "a"])
    with pytest.raises(ValueError, match="two scenes are called 'a'"):
        record(ToySource(), tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("name", ["../x", 95 * "x"])
def test_names_that_would_leave_the_folder_or_are_too_long_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    source = ToySource()
    monkeypatch.setattr(ToySource, "scenes", lambda self: [name])
    with pytest.raises(ValueError, match="cannot hold"):
        record(source, tmp_path / "data")
