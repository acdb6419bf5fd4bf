"""Steps on a Ray cluster of this machine: what processes leave, byte for byte; stopped, killed, gone on with."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from flcav.experiments.study import open_split, record_split
from flcav.runs.engine import Step, Work, run_side_by_side, run_steps

pytest.importorskip("ray", reason="the extra 'ray' is not installed")
pytestmark = pytest.mark.slow

RECIPE = {
    "town": "suburb",
    "seed": 4,
    "scenes": 1,
    "warmup_s": 9.0,
    "spins_per_scene": 2,
    "every_s": 1.0,
    "cavs": 1,
    "vehicle_rig": {"lidars": {"lidar": {"mount": {"z": 1.8}, "settings": {"channels": 4, "azimuth_steps": 90}}}},
}


def points(work: Work, step: str) -> int:
    """Return the points of a recording, and leave files in folders, one of them larger than a piece."""
    assert not (work.folder / "gone").exists()
    (work.folder / "gone").write_text("before the first report")
    work.report(0, 2, "one")
    (work.folder / "gone").unlink()
    (work.folder / "deep" / "empty").mkdir(parents=True)
    (work.folder / "deep" / "large.bin").write_bytes(bytes(20_000_000))
    work.report(1, 2, "two")
    data = open_split(work.inputs[step])
    return sum(len(data.frame(i).lidar["lidar"]) for i in range(len(data)))


def double(work: Work, step: str) -> int:
    assert (work.inputs[step] / "deep" / "large.bin").stat().st_size == 20_000_000
    return 2 * work.result(step)


def fail(work: Work) -> None:
    raise ValueError("broken step")


def kill_once(work: Work) -> str:
    """Leave a checkpoint and be killed; where there is one, return it."""
    path = work.folder / "checkpoint"
    if path.exists():
        return path.read_text()
    path.write_text("kept")
    for _ in range(100):  # one of these is heard with its files
        work.report(1, 2, "kept")
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGKILL)
    return "never"


STEPS = [
    Step("frames", record_split, {"recipe": RECIPE}),
    Step("points", points, {"step": "frames"}, needs=("frames",)),
    Step("more", record_split, {"recipe": {**RECIPE, "seed": 5}}),
    Step("double", double, {"step": "points"}, needs=("points",)),
]


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of each file, hidden ones too, and of each folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for path in folder.rglob("*")
    }


def test_a_cluster_leaves_what_processes_leave(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    told: list[tuple[str, int, int, str]] = []
    values = run_steps(STEPS, here, jobs=1, notify=lambda *event: None)
    there.mkdir()
    (there / "frames").symlink_to(here / "frames", target_is_directory=True)  # as runs share what they recorded
    assert run_steps(STEPS, there, jobs=2, notify=lambda *event: told.append(event), engine="ray") == values
    (there / "frames").unlink()
    shutil.move(here / "frames", there / "frames")
    shutil.copytree(there / "frames", here / "frames")
    assert digests(there) == digests(here)
    assert [event for event in told if event[0] == "points"] == [
        ("points", 0, 1, ""),
        ("points", 0, 2, "one"),
        ("points", 1, 2, "two"),
        ("points", 1, 1, "done"),
    ]


def test_folders_share_a_cluster_and_a_failing_step_ends_it(tmp_path: Path) -> None:
    runs = {tmp_path / "one": [Step("a", kill_never, {})], tmp_path / "two": [Step("b", fail, {})]}
    with pytest.raises(ValueError, match="broken step"):
        run_side_by_side(runs, jobs=2, notify=lambda *event: None, engine="ray")
    assert not (tmp_path / "one" / "a" / "done.json").exists()
    assert not (tmp_path / "two" / "b" / "done.json").exists()


def keep(work: Work, number: int) -> None:
    (work.folder / "number").write_text(str(number))


def read(work: Work) -> str:
    return (work.inputs["kept"] / "number").read_text()


def test_steps_of_one_name_in_two_folders_are_kept_apart(tmp_path: Path) -> None:
    runs = {
        tmp_path / str(number): [Step("kept", keep, {"number": number}), Step("read", read, {}, needs=("kept",))]
        for number in (1, 2)
    }
    values = run_side_by_side(runs, jobs=1, notify=lambda *event: None, engine="ray")
    assert [each["read"] for each in values.values()] == ["1", "2"]


def kill_never(work: Work) -> None:
    time.sleep(120)


def test_a_killed_worker_is_told_of_and_its_step_goes_on_from_what_came_back(tmp_path: Path) -> None:
    steps = [Step("a", kill_once, {})]
    with pytest.raises(OSError, match="was killed from outside"):
        run_steps(steps, tmp_path, jobs=1, notify=lambda *event: None, engine="ray")
    assert (tmp_path / "a" / "checkpoint").read_text() == "kept"
    assert run_steps(steps, tmp_path, jobs=1, notify=lambda *event: None, engine="ray") == {"a": "kept"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a"]


def test_ctrl_c_stops_the_cluster(tmp_path: Path) -> None:
    code = """
        import signal, sys
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from pathlib import Path
        import test_steps_on_ray as t
        try:
            steps = [t.Step("a", t.kill_never, {})]
            tell = lambda step, *event: step and print(step, *event, flush=True)  # those of all steps have no name
            t.run_steps(steps, Path(sys.argv[1]), jobs=1, notify=tell, engine="ray")
        except KeyboardInterrupt:
            print("stopped", flush=True)
        """
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", textwrap.dedent(code), tmp_path / "out"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env, start_new_session=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "a 0 1 \n"
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert said == "stopped\n"
    assert process.returncode == 0
