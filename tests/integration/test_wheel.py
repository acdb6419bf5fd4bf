"""What `pip install flcav` gives: a wheel, installed outside the checkout, does what the README says."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BUNDLED = ROOT / "src" / "flcav" / "planner" / "web"  # sources of planner/assets, which the wheel has
SMALL = """
size: toy
tasks: {objects: {network: tiny, history: objects}}
regions: {suburb: {role: pretrain}, grid: {role: federate}}
budgets_mb: {wireless: 40, wireline: 30}
limits: {samples: [20, null]}
"""


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
    assert "1 frame of 1 scene," in ran(installed, record, tmp_path)
    assert "1 frame, no problems" in ran(installed, [command, "validate", "data"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]


@pytest.mark.slow
def test_the_wheel_holds_what_the_checkout_holds(installed: Path, tmp_path: Path):
    where = "import flcav, flcav.reproductions.demo_arms.run; print(flcav.__file__)"
    assert Path(ran(installed, [sys.executable, "-c", where], tmp_path).strip()).parent == installed / "flcav"
    for folder, into in ((ROOT / "src" / "flcav", "."), (ROOT / "recipes", "recipes")):
        files = (
            path
            for path in folder.rglob("*")
            if path.is_file() and "__pycache__" not in path.parts and BUNDLED not in path.parents
        )
        missing = [str(path) for path in files if not (installed / "flcav" / into / path.relative_to(folder)).exists()]
        assert not missing


def started(site: Path, command: list[str | Path], cwd: Path, sign: Path) -> None:
    """Start a command in `cwd`, and kill it and its children once the file `sign` is there."""
    said = cwd / "said.txt"
    with said.open("w") as file:
        process = subprocess.Popen(
            command, cwd=cwd, env=os.environ | {"PYTHONPATH": str(site)}, stderr=file, start_new_session=True
        )
    try:
        until = time.monotonic() + 300
        while not sign.exists():
            assert process.poll() is None, said.read_text()
            assert time.monotonic() < until
            time.sleep(0.02)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_the_demo_starts_without_a_checkout(installed: Path, tmp_path: Path):
    flcav = installed / "bin" / "flcav"
    started(
        installed, [flcav, "demo", "--out", "own"], tmp_path, tmp_path / "own/work/suburb-pool-objects/started.json"
    )
    (tmp_path / "small.yaml").write_text(SMALL)
    planned = tmp_path / "small/work/plan/done.json"
    started(installed, [flcav, "demo", "--recipe", "small.yaml", "--out", "small"], tmp_path, planned)
    (plan,) = json.loads((planned.parent / "result.json").read_text())["tasks"].values()
    assert 20 <= plan["samples"] <= 24
    assert plan["predicted"] is not None  # by the history that the wheel brings


@pytest.mark.slow
def test_an_installation_reproduces_a_figure(installed: Path, tmp_path: Path):
    ran(installed, [installed / "bin" / "flcav", "reproduce", "fig3a", "--out", "own"], tmp_path)
    assert sorted(path.name for path in (tmp_path / "own").iterdir()) == ["fig3a.png", "result.json"]
