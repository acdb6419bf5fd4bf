"""Runs at toy scale that are stopped, gone on with, repeated in part, and compared."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from toy_run import RECIPE, TOY, timeless, without
from waiting import LONGEST_S, wait_for

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.runs.comparing import compare
from flcav.runs.edge_stage import federate_regions
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, load_run_recipe
from flcav.runs.results.training import Pretrained
from flcav.runs.running import run
from flcav.runs.stages.graph import Graph
from flcav.statistics.verdicts import UNDECIDED

pytestmark = pytest.mark.slow

GO = """
import sys
from pathlib import Path
from flcav.runs.recipe import load_run_recipe
from flcav.runs.running import run
run(load_run_recipe(Path(sys.argv[1])), sys.argv[2])
"""


OWN = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Last:
    def combine(self, start, updates):
        return updates[-1].weights
"""


def test_a_finished_run_is_not_done_again(finished: Path, tmp_path: Path) -> None:
    without(finished, tmp_path, lambda name: False)
    told: list[str] = []
    run(RECIPE, tmp_path, beside=TOY.parent, notify=lambda step, done, total, note: told.append(note))
    assert told == ["done before"] * len(Graph(RECIPE, TOY.parent).steps)
    assert timeless(tmp_path) == timeless(finished)
    with pytest.raises(InputError, match="another configuration"):
        run(RECIPE.model_copy(update={"seed": 2}), tmp_path, beside=TOY.parent)


def test_stage_two_alone_goes_on_with_a_run_and_ends_with_its_weights(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = without(finished, tmp_path, lambda name: name.startswith(("grid-edge-fl", "test-", "rounds-", "cloud-")))
    with pytest.raises(SystemExit) as stopped:
        command(["federate", str(TOY), "--out", str(tmp_path), "--arm", "no_pole"])  # in two processes
    assert not stopped.value.code
    printed = capsys.readouterr().out.splitlines()
    name = "grid-federate-objects-no_pole"
    assert [line.partition(": loss")[0] for line in printed[:2]] == [f"{name}, round {n} of 2" for n in (1, 2)]
    found = json.loads((tmp_path / "federation-no_pole.json").read_text())["federations"][0]
    assert [each["region"] for each in found["watched"]] == ["suburb", "grid", "ring"]
    at = {each["region"]: f"{each['region']} {each['rounds'][1]['score']:.3f}" for each in found["watched"]}
    assert printed[1].endswith(", ".join(at.values()))
    own, edge = (
        folder / "weights.safetensors" for folder in (work / name, finished / "work/grid-edge-fl-objects-no_pole")
    )
    assert (tmp_path / f"{name}.safetensors").read_bytes() == own.read_bytes() == edge.read_bytes()


def test_stage_two_alone_on_ray_ends_with_the_weights_of_a_run(finished: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    without(finished, tmp_path, lambda name: name.startswith(("grid-edge-fl", "test-", "rounds-", "cloud-")))
    federate_regions(RECIPE, tmp_path, arm="no_pole", beside=TOY.parent, runtime="ray")
    found = load_file(tmp_path / "grid-federate-objects-no_pole.safetensors")
    wanted = load_file(finished / "work/grid-edge-fl-objects-no_pole/weights.safetensors")
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_allclose(found[name], array, rtol=1e-4, atol=1e-5)


def killed_at(sign: Path, out: Path) -> None:
    """Run the recipe in a process group of its own and kill it once the file `sign` is there."""
    process = subprocess.Popen([sys.executable, "-c", GO, TOY, out], start_new_session=True)
    try:
        while not sign.exists():
            assert process.poll() is None
            time.sleep(0.002)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_run_killed_in_pretraining_and_in_edge_fl_ends_the_same(finished: Path, tmp_path: Path) -> None:
    pretrained, first = "pretrain-objects", "grid-edge-fl-objects"
    redone, ending = (first, "cloud-fl-objects"), ("equal", "densest", "no_pole", "pole8", "ring")

    def unwanted(name: str) -> bool:
        again = any(step in name for step in redone) and not name.endswith(ending)
        return again or name in ("look", pretrained)

    work = without(finished, tmp_path, unwanted)
    for step, sign in ((pretrained, "checkpoint.pt"), (first, "round1.safetensors")):
        killed_at(work / step / sign, tmp_path)
        assert not (work / step / "done.json").exists()
    run(RECIPE, tmp_path, beside=TOY.parent, jobs=2)  # alone, each stage has both workers
    assert timeless(tmp_path) == timeless(finished)
    same = [f"{step}/{name}" for step in (pretrained, *redone) for name in ("weights.safetensors", "ledger.parquet")]
    for path in (*same, f"{pretrained}/result.json"):
        assert (work / path).read_bytes() == (finished / "work" / path).read_bytes(), path
    assert [each.step for each in Pretrained.load(work / pretrained).validated] == [5, 10]


def test_runs_are_compared_on_the_same_frames(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "own.yaml").write_text(
        TOY.read_text().split("arms:")[0].replace("placement:", "federation: {strategy: own:Last}\nplacement:")
    )

    def again(name: str) -> bool:
        return (
            "-fl-" in name
            or name == "look"
            or name.startswith(
                ("test-", "rounds-", "plan-", "grid-edge", "ring-edge", "grid-errors-after", "ring-errors-after")
            )
        )

    work = without(finished, tmp_path / "own", again)
    other = run(load_run_recipe(tmp_path / "own.yaml"), work.parent)
    rows = compare(finished, work.parent)
    by_key = {(row.arm, row.stage, row.region): row for row in rows}
    assert set(by_key) == {(test.arm, test.stage, test.region) for test in other.tested}
    assert by_key[MAIN, PRETRAIN, "grid"].difference.mean == 0.0
    edge = by_key[MAIN, EDGE, "grid"]
    assert edge.second == other.test(stage=EDGE, region="grid", task="objects").estimate.mean
    assert edge.difference.mean == pytest.approx(edge.second - edge.first)
    assert {row.verdict for row in rows} == {UNDECIDED}  # the spread of retraining is not known
    weights = "grid-edge-fl-objects/weights.safetensors"
    assert (work / weights).read_bytes() != (finished / "work" / weights).read_bytes()
    with pytest.raises(InputError, match="no finished run"):
        compare(finished, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from flcav.cli.main import run; run()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "demo", "--out", tmp_path],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not (tmp_path / "work/suburb-pool-objects/data/.recording").exists():
        assert process.poll() is None
        time.sleep(0.02)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as the terminal does
    else:
        process.send_signal(number)  # the parent alone
    _, said = process.communicate(timeout=LONGEST_S)
    assert "Traceback" not in said
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert said.endswith("flcav: interrupted; the same command goes on where it stopped\n")

    def is_empty():
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return True
        return False

    wait_for(is_empty, tell=lambda: "processes of a stopped run go on")
