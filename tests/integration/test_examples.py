"""Every example runs as it stands, and is short."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import nbclient
import nbformat
import pytest
from jupyter_client.manager import AsyncKernelManager
from PIL import Image

from flcav.cli.main import run as flcav
from flcav.dataset.recording.recorder import record
from flcav.perception.networks import evaluate
from flcav.perception.objects.model import Second
from flcav.perception.tasks import task_named
from flcav.perception.weights import load_network
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *arguments: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("0*")), ids=lambda path: path.name)
def test_an_example_is_short(path: Path):
    lines = path.read_text().splitlines()
    if path.suffix == ".ipynb":
        lines = [line for cell in nbformat.read(path, as_version=4).cells for line in cell.source.splitlines()]
    assert len(lines) <= 90


@pytest.mark.slow
def test_a_notebook_shows_pictures_and_tables():
    notebook = nbformat.read(EXAMPLES / "09_notebook.ipynb", as_version=4)
    kernel = AsyncKernelManager(kernel_name="python3", transport="ipc")
    place = {"metadata": {"path": str(EXAMPLES.parent)}}
    nbclient.NotebookClient(notebook, km=kernel, timeout=300, resources=place).execute()
    shown = [
        {kind for out in cell.outputs for kind in out.get("data", {})} for cell in notebook.cells if "outputs" in cell
    ]
    assert [("image/png" in each, "text/html" in each) for each in shown] == [
        *(
            (True, False),
            (False, True),
            (True, False),
            (False, True),
            (False, True),
        ),  # town, data, frame, boxes, errors
        *((False, True), (True, False), (False, True), (True, False)),  # placement, its map, plan, its chart
    ]


@pytest.mark.slow
def test_observe_a_town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    run("01_observe_a_town.py", tmp_path, monkeypatch=monkeypatch)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2 * 3 + 1  # spins x agents, and the picture
    assert any("pole8" in line for line in said)
    with Image.open(tmp_path / "frame.png") as picture:
        assert min(picture.size) > 300


def test_allocate_a_budget(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    run("02_allocate_a_budget.py", monkeypatch=monkeypatch)
    assert "8000 MB per link" in capsys.readouterr().out


def test_place_a_sensor(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    run("03_place_a_sensor.py", monkeypatch=monkeypatch)
    assert "exact: poles" in capsys.readouterr().out


@pytest.mark.slow
def test_federate_a_detector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    run("04_federate_a_detector.py", tmp_path, monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    assert said.count("mean loss") == 2
    assert said.count(" up cav1") == said.count("down cav0") == 2
    assert "of 6 MB" in said
    assert (tmp_path / "weights.safetensors").is_file()


@pytest.mark.slow
def test_bring_your_own_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    name = "05_bring_your_own_task.py"
    run(name, tmp_path, monkeypatch=monkeypatch)
    found = re.fullmatch(r"18 vehicle frames\noff_by: (\S+)\n", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) < 3
    monkeypatch.chdir(EXAMPLES)
    shown = (EXAMPLES / name).read_text().split('"""')[1]
    commands = [line.split() for line in shown.splitlines() if line.startswith("flcav ")]
    assert [command[1] for command in commands] == ["train", "evaluate", "infer", "reproduce"]
    places = {"DIR": str(tmp_path / "data"), "own": str(tmp_path / "network"), "pictures": str(tmp_path / "pictures")}
    places["study"] = str(tmp_path / "study")
    for command in commands:
        with pytest.raises(SystemExit) as stopped:
            flcav(
                [re.sub(r"^(DIR|own|pictures|study)\b", lambda known: places[known[1]], word) for word in command[1:]]
            )
        assert stopped.value.code == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert "trained with these settings before" in said  # by the program
    assert f"off_by: {found[1]}\n" in said
    assert len(list((tmp_path / "pictures").iterdir())) == 18
    assert re.search(r"^other scenes, score: 0\.\d+", said, re.MULTILINE)
    assert (tmp_path / "study" / "counting.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_network_in_the_docs_is_trained_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    page = (EXAMPLES.parent / "docs" / "tasks.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(from torch .*?)^```$", page, re.M | re.S)
    (tmp_path / "depthwise.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    record(EmbeddedSource(Recipe(town="suburb", frames=2)), tmp_path / "data")
    for command in ("train depthwise:TASK --data data --epochs 1 --out out", "infer depthwise:TASK data"):
        learned = [] if command.startswith("train") else ["--weights", "out/weights.safetensors"]
        with pytest.raises(SystemExit, match="0"):
            flcav([*command.split(), *learned])
    with pytest.raises(SystemExit, match="2"):
        flcav(["evaluate", "depthwise:TASK", "--data", "data"])
    assert "no weights of 'depthwise' come with the package" in capsys.readouterr().err
    task = task_named("depthwise:TASK")
    network = load_network(task, "out/weights.safetensors")
    assert sum(each.numel() for each in network.parameters()) != sum(
        each.numel() for each in Second(network.config).parameters()
    )
    assert evaluate(task, "data", "out/weights.safetensors").score >= 0


@pytest.mark.slow
def test_bring_your_own_strategy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    name = "06_bring_your_own_strategy.py"
    assert len((EXAMPLES / name).read_text().splitlines()) <= 60
    run(name, tmp_path, monkeypatch=monkeypatch)
    fedavg, own = capsys.readouterr().out.splitlines()
    assert fedavg.startswith("FedAvg()")
    assert own.startswith("LossWeighted(power=2.0)")
    nights = [float(line.rsplit(" ", 1)[1]) for line in (fedavg, own)]
    assert nights[1] > nights[0]  # what few have seen


@pytest.mark.slow
def test_the_loop(tmp_path: Path):
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    shown = (EXAMPLES.parent / "docs" / "loop.md").read_text()
    names = ("towns import", "record", "train", "errors", "towns show", "place", "run", "fit", "allocate")
    assert all(f"$ flcav {name} " in shown for name in names)
    found = {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "SCENES": "1", "STEPS": "2"}
    command = ["bash", EXAMPLES / "07_the_loop.sh", EXAMPLES.parent / "recipes/maps/quarter.xodr", tmp_path / "loop"]
    done = subprocess.run(command, env=os.environ | found, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "13 candidate poles of mine" in done.stdout
    assert re.search(r"cover \d+ of \d+ errors, weight \d+ \(optimal\)", done.stdout)
    history = (tmp_path / "loop/run/history.csv").read_text().splitlines()
    assert len(history) == 1 + 1 + 5 + 1  # pretrained, each edge round, each cloud round
    assert "optimal for the fitted curve (proven" in done.stdout
    for name in ("errors.png", "placed.png", "run/pictures/map_mine.png"):
        with Image.open(tmp_path / "loop" / name) as picture:
            assert min(picture.size) > 300
    assert "<html" in (tmp_path / "loop/plan.html").read_text()


@pytest.mark.slow
def test_drive_in_live_traffic(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    run("08_drive_in_live_traffic.py", 20, monkeypatch=monkeypatch)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 4
    assert all(", 0 collisions; " in line for line in said)
    assert int(re.findall(r": (\d+) m along the route", said[-1])[0]) > 30


def test_the_program_in_the_page_of_live_traffic_runs(capsys: pytest.CaptureFixture[str]):
    page = (EXAMPLES.parent / "docs" / "live.md").read_text(encoding="utf-8")
    first, *_ = re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S)
    exec(first, {})
    assert re.match(r"\d", capsys.readouterr().out)


def test_the_loop_is_the_same_as_a_page_and_as_a_program():
    page = (EXAMPLES.parent / "docs" / "loop.md").read_text()
    program = (EXAMPLES / "07_the_loop.sh").read_text()
    typed = "\n".join(line for line in program.splitlines() if line.startswith("flcav "))
    typed = typed.replace('"$map"', "recipes/maps/quarter.xodr").replace(" --json > run.json", "")
    known = "scenes=6 steps=70\n"
    assert re.findall(r"^\$ (flcav .*)$", page, re.M) == echoed(f"{known}cat << END\n{typed}\nEND").splitlines()
    (written,) = re.findall(r"^cat > run.yaml << YAML\n(.*?)^YAML$", program, re.M | re.S)
    files = dict(re.findall(r"^```yaml (\S+)\n(.*?)^```$", page, re.M | re.S))
    assert files["run.yaml"] == echoed(f"{known}cat << END\n{written}END")
    (drive,) = re.findall(r"^drive\(\) \{ (echo .*) > .*$", program, re.M)
    for name, seed, scenes in (("learn.yaml", 11, 6), ("look.yaml", 12, 4)):
        assert files[name] == echoed(f"{known}set -- {seed} {scenes}\n{drive}")


def echoed(script: str) -> str:
    return subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True).stdout
