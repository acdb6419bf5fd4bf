"""Stages II and III of a run recipe, deployed: weights, ledgers and results are those of the run within a process."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import yaml
from waiting import wait_for

RECIPE = {
    "seed": 1,
    "size": "toy",
    "tasks": {"weather": {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 2}}},
    "regions": {
        "suburb": {"role": "pretrain"},
        "ring": {"role": "federate", "vehicles": 2},
        "grid": {"role": "federate", "vehicles": 1},
    },
    "budgets_mb": {"wireless": 9, "wireline": 9},
    "federation": {"strategy": "scaffold", "edge_rounds_per_cloud_round": 2},  # whose clients keep arrays
    "placement": {"rule": "none"},
}
CLOUD = "cloud-fl-weather"
FEDERATING = "ring-edge-fl-weather", "grid-edge-fl-weather", CLOUD
KEPT = ".safetensors", ".parquet"


def command(recipe: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "flcav", "run", str(recipe), "--out", str(out), "--jobs", "1", *more]


def run_to_the_end(asked: list[str]) -> None:
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def kill_after_first_cloud_round(asked: list[str], out: Path) -> None:
    """Run a command until its first cloud round is kept, and kill it with its group."""
    process = subprocess.Popen(asked, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    wait_for(lambda: process.poll() is not None or (out / "work" / CLOUD / "round1.safetensors").exists())
    assert process.poll() is None
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (out / "work" / CLOUD / "done.json").exists()


def read_kept(out: Path) -> dict[str, bytes]:
    """Return the files of weights, state and ledgers of the federations in a run's folder, and their results."""
    found = {}
    for step in FEDERATING:
        folder = out / "work" / step
        paths = [path for path in folder.iterdir() if path.suffix in KEPT or path.name == "result.json"]
        found |= {f"{step}/{path.name}": path.read_bytes() for path in paths}
    return found


def test_same_weights_and_ledgers_also_after_a_stop(tmp_path, deployment):
    recipe, embedded, deployed = tmp_path / "run.yaml", tmp_path / "embedded", tmp_path / "deployed"
    recipe.write_text(yaml.safe_dump(RECIPE))
    run_to_the_end(command(recipe, embedded))
    again = shutil.ignore_patterns(*FEDERATING, "rounds-*edge-fl*", "rounds-cloud*", "test-*-fl-*")
    shutil.copytree(embedded / "work", deployed / "work", ignore=again)
    asked = command(recipe, deployed, "--runtime", "flower", "--fleet", str(deployment.folder))
    kill_after_first_cloud_round(asked, deployed)
    run_to_the_end(asked)
    expected, found = read_kept(embedded), read_kept(deployed)
    assert any(name.startswith(CLOUD) for name in expected)
    assert expected.keys() == found.keys()
    assert [name for name, data in expected.items() if data != found[name]] == []
