"""The process that makes the steps of traffic: kept, started again, and gone with the one that asks."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from flcav.world.map.roads import read_net
from flcav.world.map.town import load_town
from flcav.world.traffic import client
from flcav.world.traffic.client import Sumo, write_job
from flcav.world.traffic.demand import write_demand
from flcav.world.traffic.simulation import ROUTES, StepRequest, TrafficJob

ASK = """
import sys
from pathlib import Path
from flcav.world.traffic.client import Sumo
from flcav.world.traffic.simulation import TrafficJob
sumo = Sumo(TrafficJob(sys.argv[1], 1, {}))
print(sumo._process.pid, flush=True)
sumo.record([int(sys.argv[2])], Path(sys.argv[1]) / "out.npz")
sumo.close()
print("done", flush=True)
sys.stdin.read()
"""


def asked(folder: Path, seed: int = 1, net: Path | None = None) -> TrafficJob:
    """Return a job with its files in the folder."""
    folder.mkdir(exist_ok=True)
    town = load_town("suburb")
    demand = write_demand(read_net(town.net), town.parameters, seed=1, cavs=1, from_s=1.0, until_s=9.0, fill_s=5.0)
    return write_job(folder, net or town.net, demand, seed)


def recorded(job: TrafficJob, steps: list[int]) -> np.ndarray:
    """Return the states of a run at these steps."""
    out = Path(job.folder) / "out.npz"
    with closing(Sumo(job)) as sumo:
        sumo.record(steps, out)
    with np.load(out) as arrays:
        return arrays["state"]


def same(first: np.ndarray, second: np.ndarray) -> bool:
    return np.array_equal(first, second, equal_nan=True)


def pid() -> int:
    """Return the process that the next run takes."""
    return client._idle[-1][1].pid


@pytest.mark.slow
def test_a_run_does_not_depend_on_those_before_it(tmp_path: Path):
    names = ("first", "other", "again")
    jobs = [asked(tmp_path / name, seed=2 if name == "other" else 1) for name in names]
    pids, states = [], []
    for job in jobs:
        states.append(recorded(job, [90]))
        pids.append(pid())
    assert len(set(pids)) == 1
    assert same(states[0], states[2])
    assert not same(states[0], states[1])
    os.kill(pid(), signal.SIGKILL)
    time.sleep(0.2)
    assert same(recorded(asked(tmp_path / "renewed"), [90]), states[0])
    assert pid() not in pids


def test_a_recording_is_what_steps_with_nobody_under_control_are(tmp_path: Path):
    steps = [0, 1, 40, 90]
    states = recorded(asked(tmp_path / "recorded"), steps)
    with np.load(tmp_path / "recorded/out.npz") as arrays:
        names, types = arrays["id"].tolist(), arrays["type"].tolist()
    with closing(Sumo(asked(tmp_path / "stepped"))) as sumo:
        seen = [sumo.begun, *(sumo.step(StepRequest()) for _ in range(steps[-1]))]
    assert len(seen[steps[-1]]) > len(seen[1]) > len(seen[0]) == 0
    for row, step in zip(states, steps):
        there = {names[i]: (types[i], *row[i].tolist()) for i in np.flatnonzero(~np.isnan(row[:, 0]))}
        assert there == {name: tuple(state) for name, state in seen[step].items()}


def test_what_sumo_says_of_a_bad_job_is_told_and_the_next_one_is_done(tmp_path: Path):
    job = asked(tmp_path / "bad")
    (tmp_path / "bad" / ROUTES).write_text("<routes><vehicle")
    with pytest.raises(RuntimeError, match=r"no town: TraCIException: unexpected end of input"):
        Sumo(job, "no town")
    (tmp_path / "bad/town.net.xml").unlink()
    with pytest.raises(RuntimeError, match=r"SUMO failed: Error: File .*town.net.xml' is not accessible"):
        Sumo(job)  # the reason is only in what SUMO prints
    assert len(recorded(asked(tmp_path / "good"), [50])[0])


def test_a_run_that_crashes_is_told_and_the_next_one_is_done(tmp_path: Path):
    sumo = Sumo(asked(tmp_path / "first"))
    assert sumo._process is not None
    os.kill(int(children(sumo._process.pid)), signal.SIGSEGV)
    with pytest.raises(RuntimeError, match="SUMO failed: exit code -11"):
        sumo.step(StepRequest())
    with pytest.raises(RuntimeError, match="closed"):
        sumo.step(StepRequest())
    sumo.close()
    assert len(recorded(asked(tmp_path / "second"), [50])[0])


def children(process: int) -> str:
    return Path(f"/proc/{process}/task/{process}/children").read_text()


def test_an_interrupted_request_leaves_no_answer_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    recorded(asked(tmp_path / "first"), [50])
    before = pid()
    sumo = Sumo(asked(tmp_path / "second"))
    fork = int(children(before))
    os.kill(fork, signal.SIGSTOP)  # it would answer much later

    def interrupted() -> str:
        raise KeyboardInterrupt

    assert sumo._process is not None
    monkeypatch.setattr(sumo._process.stdout, "readline", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sumo.step(StepRequest())
    monkeypatch.undo()
    os.kill(fork, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="closed"):
        sumo.step(StepRequest())
    job = asked(tmp_path / "bad")
    (tmp_path / "bad" / ROUTES).write_text("<routes><vehicle")
    with pytest.raises(RuntimeError, match="unexpected end"):
        Sumo(job)
    assert len(recorded(asked(tmp_path / "good"), [50])[0])
    assert pid() != before


def test_it_imports_nothing_from_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "json.py").write_text("raise SystemExit('a file of the user')")
    client._stop()
    monkeypatch.chdir(tmp_path)
    assert len(recorded(asked(Path("job")), [50])[0])


@pytest.mark.parametrize("name", ["one,two", "one;two", "${HOME}", "\N{GREEK SMALL LETTER LAMDA} .x", "-x"])
def test_names_of_folders_do_not_matter(name: str, tmp_path: Path):
    (tmp_path / name).mkdir()
    net = Path(shutil.copy(load_town("suburb").net, tmp_path / name / "copied.net.xml"))
    assert same(recorded(asked(tmp_path / name, net=net), [50]), recorded(asked(tmp_path / "plain"), [50]))


@pytest.mark.slow
@pytest.mark.parametrize("when", ["idle", "killed idle", "killed at work"])
def test_it_ends_with_the_process_that_started_it_without_a_word(when: str, tmp_path: Path):
    job = asked(tmp_path / "job")
    command = [sys.executable, "-c", ASK, job.folder, "20000" if when == "killed at work" else "10"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, **pipes, text=True) as process:
        assert process.stdout is not None
        server = int(process.stdout.readline())
        if when == "killed at work":
            assert children(server)
        else:
            assert process.stdout.readline() == "done\n"
        if when != "idle":
            process.kill()
        said, errors = process.communicate()  # the server has stderr, too, as long as it is there
    assert (said, errors) == ("", "")
    for _ in range(100):
        try:
            os.kill(server, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("it goes on")
