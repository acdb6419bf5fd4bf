"""The demo at toy scale, as a user has it: run, read, stopped, gone on with."""

import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.experiments.demo import demo_steps, run_demo
from flcav.experiments.planning import update_mb
from flcav.experiments.protocol import Protocol, Split, Training
from flcav.pipeline.steps import run_steps, stopwatch
from flcav.network.ledger import LINKS, Ledger, Link

pytestmark = pytest.mark.slow

TOY = Protocol(
    seed=1,
    wireless_mb=60,
    wireline_mb=40,
    max_rounds=(2, 1),
    group_range_m=1000,
    grid_vehicles=2,
    ring_vehicles=1,
    pool=Split(scenes=2, spins=3, cavs=4),
    validation=Split(scenes=1, spins=2, cavs=3),
    registry=Split(scenes=1, spins=2, cavs=2),
    edge=Split(scenes=1, spins=2, cavs=2),
    test=Split(scenes=3, spins=1, cavs=2),
    training=Training(block_steps=4, max_blocks=2, patience=1, cooldown=(0.2,), local_steps=1),
)
RUN = """
import sys
from pathlib import Path
from flcav.experiments.demo import demo_steps
from flcav.experiments.protocol import Protocol
from flcav.pipeline.steps import run_steps
steps = demo_steps(Protocol.model_validate_json(sys.argv[1]))
run_steps(steps, Path(sys.argv[2]), jobs=1, notify=lambda *told: None)
"""
OWN = """
import sys
from dataclasses import dataclass
from pathlib import Path
from flcav.experiments.demo import demo_steps
from flcav.experiments.protocol import Protocol
from flcav.pipeline.steps import run_steps

@dataclass(frozen=True)
class Last:
    def combine(self, start, updates):
        return updates[-1].weights

if __name__ == "__main__":
    steps = demo_steps(Protocol.model_validate_json(sys.argv[1]), Last())
    upto = [step.name for step in steps].index("grid-edge-chosen") + 1
    run_steps(steps[:upto], Path(sys.argv[2]), jobs=1, notify=lambda *told: None)
"""
AFTER_EDGE = (
    "cloud",
    *(f"{what}-{arm}" for what in ("test", "rounds") for arm in ("grid-edge-chosen-grid", "cloud-grid", "cloud-ring")),
    "sweep",
)


def quiet(*told: object) -> None:
    pass


def run(out: Path, notify: Callable[..., None] = quiet) -> dict[str, Any]:
    return run_demo(TOY, out, jobs=1, notify=notify, clock=stopwatch(out / "work"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("toy") / "demo"
    run(out)
    return out


@pytest.fixture(scope="module")
def results(finished: Path) -> dict[str, Any]:
    return json.loads((finished / "results.json").read_text())


def without(finished: Path, out: Path, steps: Sequence[str]) -> Path:
    """Return a copy of the finished run in which `steps` have not begun."""
    shutil.copytree(finished / "work", out / "work", ignore=lambda *_: steps)
    return out / "work"


def killed_at(sign: Path, work: Path) -> None:
    """Run the steps in `work` in a process group of their own and kill it once the file `sign` is there."""
    process = subprocess.Popen([sys.executable, "-c", RUN, TOY.model_dump_json(), work], start_new_session=True)
    try:
        while not sign.exists():
            assert process.poll() is None
            time.sleep(0.002)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def timeless(out: Path) -> dict[str, Any]:
    results = json.loads((out / "results.json").read_text())
    assert results.pop("elapsed_s") > 0
    return results


def test_the_results_name_everything(results: dict[str, Any]) -> None:
    assert results["seed"] == 1
    assert results["elapsed_s"] > 0
    assert results["test_frames"] == TOY.test.frames
    assert [stage["name"] for stage in results["stages"]] == ["pretrained", "edge FL", "edge + cloud FL"]
    for stage in results["stages"]:
        assert stage["ap50_low"] <= stage["ap50"] <= stage["ap50_high"]
        assert {"ap70", "samples", "rounds", "wireless_mb", "wireline_mb"} <= stage.keys()
    placed = results["placement"]
    assert {placed["chosen"], placed["densest"]} <= set(range(1, 10))
    assert [pole["pole"] for pole in placed["coverage"]] == list(range(1, 10))
    assert placed["covered"] == max(pole["covered"] for pole in placed["coverage"]) <= placed["errors"]
    densest = max(placed["coverage"], key=lambda pole: pole["actors"])
    assert placed["densest"] == densest["pole"]
    assert {"ap50_chosen", "ap50_densest"} <= placed.keys()
    assert results["allocation"].items() >= {"samples": TOY.pool.frames, "edge_rounds": 2, "cloud_rounds": 1}.items()


def test_the_run_leaves_history_that_fit_reads(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        command(["fit", str(finished / "history.csv"), "--json", "--repeats", "20"])
    assert not stopped.value.code
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert curve["points"] == 1 + 2 + 1  # pretrained, each edge round, each cloud round


def test_the_ledger_is_what_crossed_the_links(finished: Path, results: dict[str, Any]) -> None:
    book, pool = Ledger.load(finished / "work/cloud/ledger.parquet"), Dataset.open(finished / "work/suburb-pool/data")
    samples = sum(pool.payload_bytes(i) for i in range(len(pool))) / 1e6
    expected: dict[tuple[Link, str], float] = {
        ("wireless", "pretrain"): samples,
        ("wireline", "pretrain"): samples,
        ("wireless", "edge"): 2 * 3 * update_mb(),
        ("wireline", "edge"): 0.0,
        ("wireless", "cloud"): 3 * update_mb(),
        ("wireline", "cloud"): 2 * update_mb(),
    }
    for (link, stage), spent in expected.items():
        assert book.used_mb(link, stage=stage) == pytest.approx(spent, rel=1e-4)
    for link in LINKS:
        row = results["ledger"][link]
        assert row["used_mb"] == sum(e.bytes for e in book.entries if (e.link, e.direction) == (link, "up")) / 1e6
        assert row["used_mb"] == pytest.approx(row["planned_mb"], rel=1e-3)
        assert row["used_mb"] <= row["budget_mb"] == getattr(TOY, f"{link}_mb")
        assert sum(stage["mb"] for stage in results["ledger_by_stage"] if stage["link"] == link) == pytest.approx(
            row["used_mb"]
        )


def test_no_two_splits_share_a_scene(finished: Path) -> None:
    folders = sorted(finished.glob("work/*/data"))
    assert len(folders) == 8
    scenes = [{key.scene for key in Dataset.open(folder).keys} for folder in folders]
    assert not any(a & b for a, b in combinations(scenes, 2))


def test_findings_say_what_their_intervals_say(results: dict[str, Any]) -> None:
    differences = [*(results["differences"][name] for name in ("edge_minus_pretrained", "cloud_minus_edge"))]
    differences.append(results["placement"]["difference"])
    for finding, difference in zip(results["findings"], differences, strict=True):
        held, failed = difference["low"] > 0, difference["high"] < 0
        assert finding["verdict"] == ("held" if held else "did not hold" if failed else "undecided")
        assert f"{difference['mean']:+.3f}".replace("-", "−") in finding["sentence"]


def test_the_report_needs_no_other_file(finished: Path, results: dict[str, Any]) -> None:
    text = (finished / "report.html").read_text()
    assert all(link.startswith("data:") for link in re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]+)""", text))
    assert not re.search(r"url\(|@import|<script|<link|<iframe", text)
    read = html.unescape(re.sub(r"\s+", " ", text))
    assert all(finding["sentence"] in read for finding in results["findings"])
    for path in (finished / "pictures").iterdir():
        with Image.open(path) as picture:
            assert min(picture.size) > 300
            colours = picture.convert("RGB").resize((300, 300)).getcolors(90_000)
            assert colours is not None
            assert len(colours) > 50, path.name


def test_a_finished_demo_is_not_done_again(finished: Path, tmp_path: Path) -> None:
    without(finished, tmp_path, ())
    told: list[str] = []
    run(tmp_path, lambda step, done, total, note: told.append(note))
    assert told == ["done before"] * len(demo_steps(TOY))
    assert timeless(tmp_path) == timeless(finished)
    with pytest.raises(InputError, match="another configuration"):
        run_demo(TOY.model_copy(update={"seed": 2}), tmp_path, jobs=1, notify=quiet, clock=lambda: 0.0)


def test_a_demo_killed_in_edge_fl_ends_the_same(finished: Path, tmp_path: Path) -> None:
    redone = ("grid-edge-chosen", *AFTER_EDGE)
    work = without(finished, tmp_path, redone)
    killed_at(work / "grid-edge-chosen" / "round1.safetensors", work)
    assert not (work / "grid-edge-chosen" / "done.json").exists()
    run(tmp_path)
    assert timeless(tmp_path) == timeless(finished)
    for path in (f"{step}/{name}" for step in redone[:2] for name in ("weights.safetensors", "ledger.parquet")):
        assert (work / path).read_bytes() == (finished / "work" / path).read_bytes(), path


def test_a_strategy_of_ones_own_federates_and_is_not_gone_on_with_as_another(finished: Path, tmp_path: Path) -> None:
    edge = "grid-edge-chosen"
    work = without(finished, tmp_path, (edge, "grid-edge-densest", "ring-edge-chosen", *AFTER_EDGE))
    (tmp_path / "own.py").write_text(OWN)
    subprocess.run([sys.executable, tmp_path / "own.py", TOY.model_dump_json(), work], check=True)
    weights = f"{edge}/weights.safetensors"
    assert (work / weights).read_bytes() != (finished / "work" / weights).read_bytes()
    (work / edge / "done.json").unlink()  # killed at its end
    with pytest.raises(InputError, match="another configuration"):
        run(tmp_path)


def test_a_demo_killed_in_pretraining_ends_the_same(finished: Path, tmp_path: Path) -> None:
    steps = [step for step in demo_steps(TOY) if step.name in ("plan", "pretrain", "suburb-pool", "suburb-validation")]
    unwanted = [path.name for path in (finished / "work").iterdir() if path.name not in {step.name for step in steps}]
    work = without(finished, tmp_path, ["pretrain", *unwanted])
    shutil.copytree(finished / "work/grid-registry", work / "grid-registry")  # what comes before it in the order
    shutil.copytree(finished / "work/ring-registry", work / "ring-registry")
    killed_at(work / "pretrain" / "block1.safetensors", work)
    assert not (work / "pretrain" / "done.json").exists()
    run_steps(steps, work, jobs=1, notify=quiet)
    for name in ("weights.safetensors", "ledger.parquet", "done.json"):
        assert (work / "pretrain" / name).read_bytes() == (finished / "work/pretrain" / name).read_bytes(), name


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_demo_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
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
    while not (tmp_path / "work/suburb-pool/data/.recording").exists():
        assert process.poll() is None
        time.sleep(0.02)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as the terminal does
    else:
        process.send_signal(number)  # the parent alone
    _, said = process.communicate(timeout=30)
    assert "Traceback" not in said
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert said.endswith("flcav: interrupted; the same command goes on where it stopped\n")
    for _ in range(100):
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("processes of a stopped demo go on")
