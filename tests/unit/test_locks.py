"""Locks of folders: who holds one is told, it ends with its process, and leaves nothing behind."""

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import export, import_dataset
from flcav.dataset.recording.recorder import record
from flcav.interface.progress import ignore_progress
from flcav.machine import locks
from flcav.machine.locks import only_writer
from flcav.perception.training.run import train_prepared
from flcav.runs.engine import Step, ignore_steps, run_side_by_side, run_steps
from flcav.runs.engine.step import StepRecord
from flcav.runs.engine.workers import perform
from flcav.runs.provenance import provenance
from flcav.sources.recipe import Recipe
from flcav.world.opendrive.importing import import_town

HOLD = """
import os, sys, time
from pathlib import Path
from flcav.machine.locks import only_writer
with only_writer(Path(sys.argv[1])):
    if "fork" not in sys.argv or not os.fork():
        print(os.getpid(), flush=True)  # of a fork: it has run what a fork begins with
    time.sleep(60)
"""


@pytest.fixture
def hold() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return what starts a process that holds the lock of a path, and waits until it has it."""
    started: list[subprocess.Popen[str]] = []

    def begin(path: Path, *how: str) -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, "-c", HOLD, path, *how], stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def line(process: subprocess.Popen[str]) -> int:
    assert process.stdout is not None
    return int(process.stdout.readline())


def test_who_holds_it_is_told_and_a_killed_process_does_not_hold_it(hold: Any, tmp_path: Path) -> None:
    holder, folder = hold(tmp_path / "new" / "out"), tmp_path / "new" / "out"
    line(holder)
    (tmp_path / "link").symlink_to(tmp_path / "new")
    for path in (folder, tmp_path / "link" / "out", folder / ".." / "out"):
        told = rf"process {holder.pid} on .* since 20.*\(-c .*new/out\); wait"
        with pytest.raises(InputError, match=told), only_writer(path):
            pass
    holder.kill()
    holder.wait()
    with only_writer(folder):
        (tmp_path / "new" / "kept").touch()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["kept"]


def test_a_fork_does_not_hold_it(hold: Any, tmp_path: Path) -> None:
    holder = hold(tmp_path / "out", "fork")
    child = line(holder)
    holder.kill()
    holder.wait()
    os.kill(child, 0)
    with only_writer(tmp_path / "out"):
        os.kill(child, signal.SIGKILL)


def test_a_thread_enters_its_own_again_and_not_that_of_another(tmp_path: Path) -> None:
    said: list[str] = []

    def other() -> None:
        with pytest.raises(InputError) as error, only_writer(tmp_path):
            pass
        said.append(str(error.value))

    with only_writer(tmp_path):
        with only_writer(tmp_path):
            pass
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert f"process {os.getpid()} " in said[0]


def test_it_is_in_the_folder_where_the_one_above_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, how: path != tmp_path)
    (tmp_path / "out").mkdir()
    with only_writer(tmp_path / "out"):
        assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]
    assert not (tmp_path / "out" / ".lock").exists()


@pytest.mark.parametrize("how", ["no locks", "no file"])
def test_nobody_is_held_off_where_there_are_no_locks(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError(errno.ENOLCK if how == "no locks" else errno.EROFS, "")

    monkeypatch.setattr(*((locks.fcntl, "flock", fail) if how == "no locks" else (os, "open", fail)))
    with only_writer(tmp_path / "out"):
        assert (tmp_path / ".out.lock").exists() == (how == "no locks")
    assert not [*tmp_path.iterdir()]


STEP, HELD = (Step(name, ignore_progress, {}) for name in ("a", "out"))
WRITERS: dict[str, Callable[[Path], Any]] = {
    "record": lambda out: record(Recipe(town="ring"), out),
    "run steps": lambda out: run_steps([STEP], out, jobs=1, notify=ignore_steps),
    "run side by side": lambda out: run_side_by_side({out: [STEP]}, jobs=1, notify=ignore_steps),
    "perform": lambda out: perform(HELD, out.parent, StepRecord("", {}, ""), provenance(), ignore_progress),
    "train": lambda out: train_prepared(SimpleNamespace(out=out)),  # pyright: ignore[reportArgumentType]
    "export": lambda out: export(None, "kitti", out),  # pyright: ignore[reportArgumentType]
    "import": lambda out: import_dataset("kitti", out.parent, out),
    "import a town": lambda out: import_town(out.parent / "map.xodr", out),
}  # fmt: skip
COMMANDS = {
    "run": ("recipes/runs/demo.yaml",),
    "demo": (),
    "federate": ("recipes/runs/demo.yaml",),
    "history": ("recipes/runs/demo.yaml", "--task", "objects", "--samples", "9"),
    "reproduce": ("fig3a",),
    "fit": ("history.csv",),
    "infer": ("objects", "no.bin"),
}
OPTIONS = {"fit": "--problem", "infer": "--pictures"}


@pytest.fixture
def held(tmp_path: Path) -> Iterator[Path]:
    """Return a folder that another thread holds."""
    begun, over = threading.Event(), threading.Event()

    def wait() -> None:
        with only_writer(tmp_path / "out"):
            begun.set()
            over.wait()

    thread = threading.Thread(target=wait)
    thread.start()
    begun.wait()
    yield tmp_path / "out"
    over.set()
    thread.join()


@pytest.mark.parametrize("writer", WRITERS)
def test_whatever_writes_a_folder_leaves_it_to_the_one_that_does(writer: str, held: Path) -> None:
    with pytest.raises(InputError, match=r"writes there since .*; wait for its end, or choose another folder"):
        WRITERS[writer](held)
    assert not held.exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_the_second_command_ends_with_a_sentence(command: str, held: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run([command, *COMMANDS[command], OPTIONS.get(command, "--out"), str(held)])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(f"flcav: {held}: process {os.getpid()} on ")
    assert not held.exists()
