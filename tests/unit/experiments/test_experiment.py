"""A user's own experiment, a folder anywhere, is repeated and tabulated as those that come with flcav are."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from reproduction_pages import main as fill_pages
from waiting import wait_for

from flcav.cli.main import run
from flcav.config import InputError
from flcav.experiments import list_experiments
from flcav.experiments.experiment import load_experiment

SCRIPT = """
from dataclasses import dataclass
from pathlib import Path

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.runs.engine import Step, Work, run_steps
from flcav.storage.markdown import format_table


@dataclass(frozen=True)
class Squares:
    squares: tuple[int, ...]


def square(work: Work, *, seed: int) -> int:
    return seed * seed


def _run(out: Path, options: Options) -> Outcome[Squares]:
    steps = [Step(f"seed{seed}", square, {"seed": seed}) for seed in range(1, options.seeds + 1)]
    with options.show_steps(options.title) as notify:
        values = run_steps(steps, out, **options.how(notify))
    return Outcome(Squares(tuple(values[step.name] for step in steps)), {"dot.png": b"PNG"}, ["squared"])


def tables(results: Squares) -> dict[str, str]:
    return {"squares": format_table(("n",), [[each] for each in results.squares])}


EXPERIMENT = Experiment(Squares, _run, tables)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "path", [*sys.path])
    own = tmp_path / "squares_of_seeds"
    own.mkdir()
    (own / "run.py").write_text(SCRIPT)
    (own / "README.md").write_text("<!-- squares -->\n<!-- end -->\n")
    return own


@pytest.mark.slow
def test_a_folder_of_ones_own_is_run_in_processes_and_fills_its_page(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        run(["reproduce", str(folder), "--seeds", "3", "--jobs", "2", "--out", str(folder / "out")])
    assert not ended.value.code
    assert "squared" in capsys.readouterr().out
    assert json.loads((folder / "out/result.json").read_text()) == {"squares": [1, 4, 9]}
    assert (folder / "out/dot.png").read_bytes() == b"PNG"
    (folder / "out/result.json").rename(folder / "result.json")
    fill_pages([str(folder)])
    assert (folder / "README.md").read_text() == "<!-- squares -->\n| n |\n|---|\n| 1 |\n| 4 |\n| 9 |\n<!-- end -->\n"


@pytest.mark.slow
def test_a_killed_study_goes_on_after_the_seeds_that_were_done(folder: Path) -> None:
    waiting = "    while seed == 2 and not Path(__file__).with_name('go').exists():\n        time.sleep(0.01)\n"
    counting = "    (Path(__file__).parent / f'{seed}-{os.getpid()}').touch()\n"
    script = SCRIPT.replace("    return seed * seed", f"{counting}{waiting}    return seed * seed")
    (folder / "run.py").write_text(f"import os\nimport time\n{script}")
    options = ["reproduce", str(folder), "--seeds", "3", "--jobs", "1", "--out", str(folder / "out")]
    process = subprocess.Popen([sys.executable, "-m", "flcav", *options], start_new_session=True)
    wait_for(lambda: [*folder.glob("2-*")], tell=lambda: "the second seed never began")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    (folder / "go").touch()
    subprocess.run([sys.executable, "-m", "flcav", *options], check=True)
    assert json.loads((folder / "out/result.json").read_text()) == {"squares": [1, 4, 9]}
    assert [len([*folder.glob(f"{seed}-*")]) for seed in (1, 2, 3)] == [1, 2, 1]


def test_what_is_no_experiment_is_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name, script, said in (
        ("own_bare", "", "has no EXPERIMENT"),
        ("own_broken", "import nothing_there", "cannot be imported .ModuleNotFoundError"),
        ("json", "", "cannot be imported|is installed"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.py").write_text(script)
        with pytest.raises(InputError, match=said):
            load_experiment(str(tmp_path / name))
    with pytest.raises(InputError, match=r"nor one of .*fig3a"):
        load_experiment("fig3")


def test_each_experiment_of_the_checkout_is_found_by_its_folder_and_by_its_name():
    root = Path(__file__).parents[3] / "reproductions"
    folders = [path.parent for path in root.rglob("run.py")]
    assert len(folders) == len(list_experiments()) > 30
    found = load_experiment(str(root / "federation" / "groups"))
    assert found is load_experiment("federation-groups")


@pytest.mark.parametrize(
    ("name", "recipe", "table"), [("gap", "gap", "differences"), ("fig6a-allocation", "allocation", "plans")]
)
def test_results_of_another_recipe_are_refused_by_its_name(name: str, recipe: str, table: str) -> None:
    experiment = load_experiment(name)
    held = json.loads((list_experiments()[name] / "result.json").read_text())
    assert table in experiment.tabulate(held, "result.json")
    range_m = held["recipe"]["placement"]["range_m"]
    held["recipe"]["placement"]["range_m"] = 7
    with pytest.raises(
        InputError, match=rf"result\.json: of another recipe than recipes/runs/{recipe}\.yaml, .*{range_m}, and not 7"
    ):
        experiment.tabulate(held, "result.json")
    del held["recipe"]
    with pytest.raises(InputError, match=f"of another recipe than recipes/runs/{recipe}"):
        experiment.tabulate(held, "result.json")
