"""What `pip install flcav` gives: a wheel, installed outside the checkout, does what the README says."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder into which the checkout's wheel was installed; its dependencies are those of the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", folder, ROOT], check=True, cwd=folder)
    (wheel,) = folder.glob("flcav-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", folder / "site", wheel], check=True, cwd=folder)
    return folder / "site"


def ran(site: Path, command: list[str | Path], cwd: Path) -> str:
    """Return what a command says that sees the installed package, and the checkout nowhere."""
    done = subprocess.run(
        command, cwd=cwd, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_recipes_of_the_readme_are_installed(installed: Path, tmp_path: Path):
    command = installed / "bin" / "flcav"
    plan = json.loads(ran(installed, [command, "allocate", "recipes/allocation/three_tasks.yaml", "--json"], tmp_path))
    assert [task["name"] for task in plan["tasks"]] == ["weather", "signs", "objects"]
    record = [command, "record", "recipes/suburb.yaml", "--frames", "1", "--out", "data"]
    assert "1 frames of 1 scenes" in ran(installed, record, tmp_path)
    assert "1 frames" in ran(installed, [command, "validate", "data"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]


@pytest.mark.slow
def test_the_wheel_holds_what_the_checkout_holds(installed: Path, tmp_path: Path):
    where = "import flcav, flcav.experiments.studies; print(flcav.__file__)"
    assert Path(ran(installed, [sys.executable, "-c", where], tmp_path).strip()).parent == installed / "flcav"
    for folder, into in ((ROOT / "src" / "flcav", "."), (ROOT / "recipes", "recipes")):
        files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        missing = [str(path) for path in files if not (installed / "flcav" / into / path.relative_to(folder)).exists()]
        assert not missing
