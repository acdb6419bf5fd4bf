"""Each extra of a run is one folder: without it and its registration, the rest runs the demo's recipe at toy size."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flcav.runs.recipe import load_run_recipe

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
EXTRAS = sorted(path.parent.name for path in (ROOT / "src/flcav/runs/extras").glob("*/__init__.py"))
BUILT_ON = {"groups": ("lifelong", "partition")}  # extras that use another one, and go with it
PROGRAM = """
import sys
import flcav
from flcav.report.pages.run_page import write_report
run = flcav.run(sys.argv[1], sys.argv[2], stale="redo", notify=lambda *told: None)
write_report(run, sys.argv[2])
print(flcav.__file__)
"""


def take_out(package: Path, extra: str) -> None:
    """Delete an extra's folder, and what `registry.py` has of it: imports with their names, and named functions."""
    shutil.rmtree(package / "runs/extras" / extra)
    registry = package / "runs/registry.py"
    text = registry.read_text()
    for line in re.findall(rf"^from flcav\.runs\.extras\.{extra}\..*\n", text, re.MULTILINE):
        text = text.replace(line, "")
        for name in re.split(r",\s*", line.partition(" import ")[2].strip()):
            text = re.sub(rf"^ +(\*\*)?{name},\n", "", text, flags=re.MULTILINE)
            assert name not in text
    registry.write_text(re.sub(rf'"flcav\.runs\.extras\.{extra}\.[\w.:]+",?', "", text))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the demo's recipe at toy size, whose recordings all runs share."""
    folder = tmp_path_factory.mktemp("extras")
    asked = load_run_recipe(ROOT / "recipes/runs/demo.yaml").model_dump(
        mode="json", exclude={"distillation", "lifelong"}
    )
    few = {"scenes": 1, "spins": 2, "cavs": 1}
    asked["splits"] = dict.fromkeys(("pool", "validation", "registry", "edge"), few) | {"test": few | {"scenes": 2}}
    asked["regions"] = {name: asked["regions"][name] for name in ("suburb", "grid")}
    asked["regions"]["grid"]["vehicles"] = 2
    asked["tasks"]["objects"] |= {"history": None, "plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 1}}
    asked |= {"training": {"steps": 2, "local_steps": 1}, "retrainings": 0, "horizon_s": None, "primary_claims": []}
    for field in ("requests", "partition"):
        asked["federation"].pop(field)
    for arm in asked["arms"].values():
        arm.pop("distillation")
    (folder / "recipe.yaml").write_text(json.dumps(asked))
    return folder


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_demo_runs_without_an_extra(extra: str, work: Path, tmp_path: Path) -> None:
    package = tmp_path / "flcav"
    shutil.copytree(ROOT / "src/flcav", package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in (extra, *BUILT_ON.get(extra, ())):
        take_out(package, name)
    (work / "run/results.json").unlink(missing_ok=True)  # it has the fields of the extras of before
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", PROGRAM, str(work / "recipe.yaml"), str(work / "run")]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(package / "__init__.py")
    assert (work / "run/report.html").stat().st_size > 10_000
