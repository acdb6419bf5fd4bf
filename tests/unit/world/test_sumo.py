"""The process that simulates traffic: kept, started again, and gone with the one that asks."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flcav.world.map.roads import read_net
from flcav.world.map.town import load_town
from flcav.world.traffic import sumo
from flcav.world.traffic.demand import write_demand

ASK = """
import sys
from pathlib import Path
from flcav.world.traffic import sumo
print(sumo._running().pid, flush=True)
sumo.simulate_in(Path(sys.argv[1]))
print("done", flush=True)
sys.stdin.read()
"""


def asked(folder: Path, steps: list[int], seed: int = 1) -> Path:
    """Return the folder of a job."""
    folder.mkdir()
    town = load_town("suburb")
    demand = write_demand(read_net(town.net), town.parameters, seed=1, cavs=1, from_s=1.0, until_s=9.0, fill_s=5.0)
    (folder / "routes.xml").write_text(demand.routes)
    job = {"net": str(town.net), "routes": str(folder / "routes.xml"), "seed": seed, "steps": steps}
    job |= {"scenarios": [], "followers": {}}
    (folder / "job.json").write_text(json.dumps(job))
    return folder


def states(folder: Path) -> bytes:
    with np.load(folder / "out.npz") as arrays:
        return arrays["state"].tobytes()


def pid() -> int:
    assert sumo._process is not None
    return sumo._process[1].pid


def test_a_simulation_does_not_depend_on_those_before_it(tmp_path: Path):
    names = ("first", "other", "again")
    folders = [asked(tmp_path / name, [90], seed=2 if name == "other" else 1) for name in names]
    pids = []
    for folder in folders:
        sumo.simulate_in(folder)
        pids.append(pid())
    assert len(set(pids)) == 1
    assert states(folders[0]) == states(folders[2]) != states(folders[1])
    os.kill(pid(), signal.SIGKILL)
    time.sleep(0.2)
    renewed = asked(tmp_path / "renewed", [90])
    sumo.simulate_in(renewed)
    assert pid() not in pids
    assert states(renewed) == states(folders[0])


def test_what_sumo_says_of_a_bad_job_is_told_and_the_next_one_is_done(tmp_path: Path):
    folder = asked(tmp_path / "bad", [50])
    (folder / "routes.xml").write_text("<routes><vehicle")
    with pytest.raises(RuntimeError, match="unexpected end of input"):
        sumo.simulate_in(folder)
    with pytest.raises(RuntimeError, match="1"):
        sumo.simulate_in(tmp_path / "none")
    good = asked(tmp_path / "good", [50])
    sumo.simulate_in(good)
    assert states(good)


def test_an_interrupted_simulation_leaves_no_answer_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = asked(tmp_path / "first", [50])
    sumo.simulate_in(first)
    assert sumo._process is not None
    before = pid()

    def interrupted() -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(sumo._process[1].stdout, "readline", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sumo.simulate_in(asked(tmp_path / "second", [50]))
    bad = asked(tmp_path / "bad", [50])
    (bad / "routes.xml").write_text("<routes><vehicle")
    with pytest.raises(RuntimeError):
        sumo.simulate_in(bad)
    assert pid() != before


def test_it_imports_nothing_from_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "json.py").write_text("raise SystemExit('a file of the user')")
    sumo._stop()
    monkeypatch.chdir(tmp_path)
    sumo.simulate_in(asked(tmp_path / "job", [50]))


@pytest.mark.parametrize("name", ["one,two", "one;two", "${HOME}", "\N{GREEK SMALL LETTER LAMDA} .x", "-x"])
def test_names_of_folders_do_not_matter(name: str, tmp_path: Path):
    plain, odd = asked(tmp_path / "plain", [50]), asked(tmp_path / name, [50])
    job = json.loads((odd / "job.json").read_text())
    net = shutil.copy(job["net"], odd / "town.net.xml")
    (odd / "job.json").write_text(json.dumps(job | {"net": str(net)}))
    for folder in (plain, odd):
        sumo.simulate_in(folder)
    assert states(odd) == states(plain)


@pytest.mark.parametrize("when", ["idle", "killed idle", "killed at work"])
def test_it_ends_with_the_process_that_started_it_without_a_word(when: str, tmp_path: Path):
    steps = [20_000] if when == "killed at work" else [10]
    command = [sys.executable, "-c", ASK, asked(tmp_path / "job", steps)]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, **pipes, text=True) as process:
        assert process.stdout is not None
        server = int(process.stdout.readline())
        if when == "killed at work":
            while not (tmp_path / "job/said.txt").exists():  # the fork has begun
                assert process.poll() is None
                time.sleep(0.001)
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
