"""Stage II of a run recipe by `flcav federate`, deployed: the file of weights is that of the embedded federation."""

import shutil
import subprocess
import sys
from pathlib import Path

import yaml

RECIPE = {
    "seed": 1,
    "size": "toy",
    "tasks": {"weather": {"plan": {"samples": 4, "edge_rounds": 2, "cloud_rounds": 1}}},
    "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate", "vehicles": 2}},
    "budgets_mb": {"wireless": 9, "wireline": 9},
    "placement": {"rule": "none"},
}
STEP = "ring-federate-weather"


def federate(recipe: Path, out: Path, *more: str) -> bytes:
    """Return the file of weights of a federation in the folder `out`."""
    command = [sys.executable, "-m", "flcav", "federate", str(recipe), "--out", str(out), "--jobs", "1", *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return (out / f"{STEP}.safetensors").read_bytes()


def test_same_file_of_weights(tmp_path, deployment):
    recipe = tmp_path / "run.yaml"
    recipe.write_text(yaml.safe_dump(RECIPE))
    embedded = federate(recipe, tmp_path / "embedded")
    shutil.copytree(tmp_path / "embedded/work", tmp_path / "deployed/work", ignore=shutil.ignore_patterns(STEP))
    deployed = federate(recipe, tmp_path / "deployed", "--runtime", "flower", "--fleet", str(deployment.folder))
    assert embedded == deployed
    ledgers = (path / "work" / STEP / "ledger.parquet" for path in (tmp_path / "embedded", tmp_path / "deployed"))
    assert len({path.read_bytes() for path in ledgers}) == 1
